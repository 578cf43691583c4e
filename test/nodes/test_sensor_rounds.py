"""What the calibration says before the turn of a sensor comes."""

from mag_tracking.network.file import read_network
from mag_tracking.nodes.sensor_rounds import SensorRounds
from mag_tracking.pipeline import settings_for
from mag_tracking.stages.calibrate.stage import Calibrate
from support.bundled import NETWORK_FILE
from support.dense_traffic import after_dense_traffic


def test_each_background_that_becomes_doubtful_is_told_at_once():
    """While that of another sensor is, too; and once."""
    network, told = read_network(NETWORK_FILE), []
    stage = Calibrate(network, settings_for('vehicle').calibrate)
    rounds = SensorRounds('calibration_node', network, stage, None, None, lambda: True, None,
                          lambda states: told.append(list(states)))
    begun = set()
    readings = after_dense_traffic('junction_left_to_right', 7.0)
    for i in range(0, len(readings), 40):
        stage.feed(readings.part(slice(i, i + 40)))
        doubtful = {name: b.doubtful_times[-1][0] for name, b in stage.backgrounds().items()
                    if b.doubtful}
        n = len(told)
        for _ in range(2):
            rounds.report_doubts()
        news = doubtful.items() - begun
        assert len(told) == n + bool(news)
        if news:
            assert {name for name, _ in news} <= {s.sensor for s in told[-1] if s.doubtful}
        begun |= news
    # One of them twice, and the second while the first was doubtful.
    assert len(told) == len(begun) == 4
