"""Published records of a track share no memory with the bank."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import SmoothedPose, Track
from support.bundled import NETWORK_FILE, VEHICLES, vehicle_path


def arrays_of(value, depth=0):
    """All arrays in a record and in the objects that it contains."""
    if isinstance(value, np.ndarray):
        yield value
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from arrays_of(getattr(value, field.name), depth + 1)
    elif hasattr(value, '__dict__') and depth < 4:
        for content in vars(value).values():
            yield from arrays_of(content, depth + 1)


@pytest.mark.parametrize('lag_s', [0.0, 0.5])
def test_records_share_no_memory_with_the_bank(lag_s):
    """The filter modifies the states and covariances of its bank in place."""
    network, n_records = read_network(NETWORK_FILE), 0
    pipeline = Pipeline(network, settings_for('vehicle', {'track.smoothing_lag_s': lag_s}))
    for readings in SampleReader(Recording(vehicle_path(VEHICLES[0])), network).readings():
        for record in pipeline.feed(readings):
            bank = pipeline.track.bank
            if not isinstance(record, (Track, SmoothedPose)) or bank is None:
                continue
            n_records += 1
            for array in arrays_of(record):
                assert not np.shares_memory(array, bank.x)
                assert not np.shares_memory(array, bank.P)
    assert n_records > 30
