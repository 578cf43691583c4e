"""Hard and soft iron of tumbled sensors: what `mag-tracking tumble` does."""

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.ellipsoid_fit import EllipsoidFit, fit_ellipsoid
from mag_tracking.network import SensorNetwork
from mag_tracking.recording.interruptible import ReadingStopped, until_stopped
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader


def tumble(recording: Recording, network: SensorNetwork, sensors: Collection[str], date: str,
           field_size: float | None = None, progress: Callable[[int], object] | None = None,
           stopped: Callable[[], bool] | None = None,
           ) -> tuple[SensorNetwork, dict[str, EllipsoidFit], dict[str, FloatArray], bool]:
    """Hard and soft iron of sensors that were turned about while a recording was made.

    Parameters
    ----------
    recording : Recording
    network : SensorNetwork
    sensors : collection of str
        Names; empty = all.
    date : str
        What the calibration is marked with.
    field_size : float [T], optional
        Of the field where they were turned; without it the sensors' gain is left as it is.
    progress, stopped : function, optional
        As for `calibrate`.

    Returns
    -------
    (SensorNetwork with what converged, but without those sensors' backgrounds and noise, which were
    of uncorrected readings; {sensor: EllipsoidFit}, {sensor: readings (n, 3)},
    interrupted)

    Raises NetworkError for an unknown sensor, RecordingError where the recording has none
    of the network's topics.
    """
    wanted = tuple(sensors) or network.names
    rows = {name: network.index(name) for name in wanted}
    taken: dict[str, list[FloatArray]] = {name: [] for name in wanted}
    interrupted = False
    reader = SampleReader(recording, network)
    try:
        for batch in until_stopped(reader.readings, progress, stopped):
            of = batch.rows({name: k for k, name in enumerate(wanted)})
            of[np.isinf(batch.field).any(axis=1)] = -1
            for k, name in enumerate(wanted):
                taken[name].append(batch.field[of == k])
    except ReadingStopped:
        interrupted = True
    readings: dict[str, FloatArray] = {
        name: np.concatenate([np.empty((0, 3)), *r]) for name, r in taken.items()}
    fits = {name: fit_ellipsoid(r, field_size) for name, r in readings.items()}
    columns = {key: list(getattr(network, key)) for key in (
        'offset', 'correction', 'background', 'noise_std', 'calibrated')}
    for name, fit in fits.items():
        j = rows[name]
        if not fit.converged:
            continue
        columns['offset'][j], columns['correction'][j] = fit.offset, fit.correction
        # They were of readings that were not corrected so; both are learnt anew.
        columns['background'][j] = columns['noise_std'][j] = None
        done = network.calibrated[j]
        columns['calibrated'][j] = network.calibration_record(
            j, date, f'{"as stated" if done is None else done.by}; tumbled to '
            f'{100 * fit.residual:.1f} % of the field', float('nan') if done is None
            else done.clock_offset_std)
    changes: dict[str, Any] = {key: tuple(v) for key, v in columns.items()}
    return replace(network, **changes), fits, readings, interrupted
