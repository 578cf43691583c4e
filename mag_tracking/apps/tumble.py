"""Calibration of hard and soft iron by tumbling, for `mag-tracking calibrate tumble`."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.ellipsoid_fit import EllipsoidFit, fit_ellipsoid
from mag_tracking.errors import RecordingError
from mag_tracking.network import SensorNetwork
from mag_tracking.recording.message_block import Progress, ReadingStopped, until_stopped
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import Readings


def tumble(source: Recording | Sequence[Readings], network: SensorNetwork,
           sensors: Collection[str], date: str,
           field_magnitude: float | None = None, progress: Callable[[int], object] | None = None,
           stopped: Callable[[], bool] | None = None,
           ) -> tuple[SensorNetwork, dict[str, EllipsoidFit], dict[str, FloatArray], bool]:
    """Estimate the hard and soft iron of sensors that were rotated during a recording.

    No `sensors` selects all. Without `field_magnitude` [T] of the ambient field, the mean gain of a
    sensor is not calibrated. The results are the network with the corrections of the sensors whose
    fit converged, the fits, the readings (n, 3) [T, sensor frame], and whether reading was stopped.
    Background and noise of corrected sensors are removed: they refer to uncorrected readings.
    """
    selected = tuple(sensors) or network.names
    rows = {name: network.index(name) for name in selected}
    collected: dict[str, list[FloatArray]] = {name: [] for name in selected}
    interrupted = False
    try:
        for batch in until_stopped(_batches(source, network), progress, stopped):
            sensor = batch.rows({name: k for k, name in enumerate(selected)})
            sensor[np.isinf(batch.field).any(axis=1)] = -1
            for k, name in enumerate(selected):
                collected[name].append(batch.field[sensor == k])
    except ReadingStopped:
        interrupted = True
    readings: dict[str, FloatArray] = {
        name: np.concatenate([np.empty((0, 3)), *r]) for name, r in collected.items()}
    fits = {name: fit_ellipsoid(r, field_magnitude) for name, r in readings.items()}
    columns = {key: list(getattr(network, key)) for key in (
        'offset', 'correction', 'background', 'noise_std', 'calibrated')}
    for name, fit in fits.items():
        j = rows[name]
        if not fit.converged:
            continue
        columns['offset'][j], columns['correction'][j] = fit.offset, fit.correction
        # Background and noise refer to uncorrected readings; both will be learnt again.
        columns['background'][j] = columns['noise_std'][j] = None
        record = network.calibrated[j]
        columns['calibrated'][j] = network.calibration_record(
            j, date, f'{"nominal orientation" if record is None else record.by}; tumbled with '
            f'a residual of {100 * fit.residual:.1f} % of the field', float('nan') if record is None
            else record.clock_offset_std)
    changes: dict[str, Any] = {key: tuple(v) for key, v in columns.items()}
    return replace(network, **changes), fits, readings, interrupted


def _batches(source: Recording | Sequence[Readings], network: SensorNetwork
             ) -> Callable[[Progress | None], Iterator[Readings]]:
    """Return a function that iterates over the readings of the network."""
    if isinstance(source, Recording):
        return SampleReader(source, network).readings
    names = dict.fromkeys(name for batch in source for name in batch.names)
    if not set(names) & set(network.names):
        raise RecordingError(f'the table has the sensors {", ".join(names)}, and the network '
                             f'{", ".join(network.names)}')
    return lambda progress: iter(source)
