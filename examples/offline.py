"""The same code without ROS: samples in, tracks out, in ten lines."""

from pathlib import Path

from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import Track

ROOT = Path(__file__).resolve().parents[1]


def tracks(recording):
    """Every `Track` record of a recording of the junction."""
    network = read_network(ROOT / 'config' / 'network.yaml')
    pipeline = Pipeline(network, settings_for('vehicle'))
    for readings in SampleReader(Recording(recording), network).readings():
        yield from (r for r in pipeline.feed(readings) if isinstance(r, Track))
    yield from (r for r in pipeline.flush() if isinstance(r, Track))


if __name__ == '__main__':
    for track in tracks(ROOT / 'test' / 'data' / 'vehicles' / 'straight_car_right.mcap'):
        print(track.stamp_ns, track.id, track.position.round(2), track.arrival, track.ambiguous)
