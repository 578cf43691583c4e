"""Changes of doubtful backgrounds are published without waiting for the end of a round."""

from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from mag_tracking.calibration.doubtful_times import DOUBTFUL_BACKGROUND, merged
from mag_tracking.messages.network import doubtful_times
from mag_tracking.network.file import read_network
from mag_tracking.nodes.sensor_rounds import SensorRounds
from mag_tracking.pipeline import settings_for
from mag_tracking.stages.calibrate.stage import Calibrate
from support.bundled import NETWORK_FILE
from support.dense_traffic import after_dense_traffic

READINGS = after_dense_traffic('junction_left_to_right', 7.0)
"""Both backgrounds become doubtful twice, for a while at the same time."""
BATCH_SIZE = 40


class Listener:
    """Merges the published doubtful intervals as the tracker does."""

    def __init__(self):
        self.network = read_network(NETWORK_FILE)
        self.stage = Calibrate(self.network, settings_for('vehicle').calibrate)
        self.rounds = SensorRounds('calibration_node', self.network, self.stage, Mock(), Mock(),
                                   lambda: True, Mock(), self.receive)
        self.n, self.times = 0, {}

    def receive(self, states):
        self.n += 1
        self.times = merged(self.times, doubtful_times(SimpleNamespace(sensors=states)))

    def feed(self, k):
        """Feed batch `k` of the readings."""
        self.stage.feed(READINGS.part(slice(k * BATCH_SIZE, (k + 1) * BATCH_SIZE)))
        self.rounds.report_doubts()

    @property
    def is_consistent(self):
        """Whether the received intervals equal the intervals of the calibration stage."""
        return {n: t for n, t in self.times.items() if t} == self.stage.input_doubts().get(
            DOUBTFUL_BACKGROUND, {})


def test_each_begin_and_end_of_a_doubt_is_reported_once_without_delay():
    listener, changes = Listener(), 0
    for k in range(len(READINGS) // BATCH_SIZE):
        before = listener.stage.input_doubts()
        listener.feed(k)
        changes += listener.stage.input_doubts() != before
        listener.rounds.report_doubts()
        assert listener.is_consistent and listener.n == changes
    assert [len(t) for t in listener.times.values()] == [2, 2]


@pytest.mark.parametrize('steps', [1, 2, 3, 5])
@pytest.mark.parametrize('phase', [0, 1, 2])
def test_rounds_of_any_length_agree_with_the_reports(steps, phase):
    """A round updates the published states of the sensors at different times."""
    listener = Listener()
    for k in range(len(READINGS) // BATCH_SIZE):
        listener.feed(k)
        if (k + phase) % steps == 0:
            listener.rounds.tick()
            listener.rounds.step_if_due()
        assert listener.is_consistent


def test_relearning_ends_a_doubt():
    """The doubt also ends if it began with the latest reading."""
    listener, n = Listener(), 0
    while not listener.stage.input_doubts():
        listener.feed(n)
        n += 1
    listener.stage.forget(())
    listener.rounds.report_doubts()
    assert listener.is_consistent and listener.times['mag_1'][-1][1] is not None
    for k in range(n, len(READINGS) // BATCH_SIZE):
        listener.feed(k)
    assert listener.is_consistent
