"""Geometry of a board of sensors from a table of poses: what `mag-tracking board-geometry` does."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np

from mag_tracking.analysis.network_blind import calibrate_geometry_blind
from mag_tracking.analysis.network_geometry import (
    GeometrySettings,
    NetworkGeometry,
    calibrate_geometry,
)
from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.errors import NetworkError, RecordingError
from mag_tracking.network import SensorNetwork
from mag_tracking.recording.pose_table import (
    read_pose_table,
    read_readings,
    read_sensor_positions,
)

ASSUMED_NOISE = 1e-7
"""[T] Of sensors of which nobody says it; near a magnet the error of the field is larger."""

MIN_TURN = 1e-7
"""[rad] A smaller deviation is one of an orientation that was held fixed."""

FIRST_ROW = 2
"""The row of the first pose, as messages count them: the header is row 1."""


@dataclass(frozen=True)
class GeometrySurvey:
    """What a table of poses told of a board."""

    stated: SensorNetwork
    """As it was, with the noise that was counted with."""
    network: SensorNetwork
    """To be written; not to be used where the geometry has not converged."""
    geometry: NetworkGeometry
    rows: IntArray
    """(K,) rows of the table, of the poses that were used."""
    suspect_rows: tuple[int, ...]
    n_poses: int
    """In the table."""
    silent_axes: tuple[tuple[str, str], ...]
    """(sensor, axes) that never reported, of sensors that did."""

    @property
    def rotation_angle(self) -> FloatArray:
        """(n,) [rad] from the stated orientations."""
        trace: FloatArray = np.einsum('nij,nij->n', self.stated.R_ws, self.network.R_ws)
        return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def board_of(path: str | PathLike[str]) -> SensorNetwork:
    """A network of untried sensors `mag_0`, `mag_1`, ... at the positions of a CSV, along x, y, z.

    Raises RecordingError and NetworkError.
    """
    positions = read_sensor_positions(path)
    names = tuple(f'mag_{j}' for j in range(len(positions)))
    try:
        return SensorNetwork(names, positions, np.tile(np.eye(3), (len(names), 1, 1)),
                             tuple(f'/{name}/imu/mag' for name in names))
    except NetworkError as error:
        raise NetworkError(f'{path}: {error}') from error


def survey_geometry(table: str | PathLike[str], network: SensorNetwork, moment: float,
                    settings: GeometrySettings, date: str,
                    box: tuple[Sequence[float], Sequence[float]] | None = None,
                    noise_std: float | None = None) -> GeometrySurvey:
    """Geometry of a network from a table of a magnet's poses.

    Parameters
    ----------
    table : path
        As for `read_pose_table`.
    network : SensorNetwork
        As stated; the order of its sensors is that of the table's columns. What it has of offsets
        and corrections is applied to the readings, as it will be later.
    moment : float [A m^2]
    settings : GeometrySettings
    date : str
        What the calibration is marked with.
    box : (low, high), optional
        Corners (3,) [m] of where the magnet was; with it the table needs no poses.
    noise_std : float [T], optional
        Of the sensors of which the network does not say it; without it `ASSUMED_NOISE` is counted
        with, and not written.

    Returns
    -------
    GeometrySurvey

    Raises RecordingError for a table that cannot be read or used.
    """
    if box is None:
        readings, positions, axes = read_pose_table(table)
    else:
        readings = read_readings(table)
    if readings.shape[1] != len(network):
        raise RecordingError(f'{table} has readings of {readings.shape[1]} sensors, but the '
                             f'network has {len(network)}')
    known = _with_noise(network, noise_std)
    stated = _with_noise(known, ASSUMED_NOISE)
    field = corrected(stated, readings)
    # A pose without any reading tells nothing; without a tracker it is left out below.
    given = np.arange(len(field)) if box is not None else np.flatnonzero(
        ~np.isnan(field).all(axis=(1, 2)))
    try:
        if box is not None:
            low, high = (np.asarray(corner, dtype=float) for corner in box)
            found = calibrate_geometry_blind(stated, field, moment, low, high, settings)
        else:
            found = calibrate_geometry(stated, field[given], positions[given], axes[given],
                                       moment, settings)
    except ValueError as error:
        raise RecordingError(f'{table}: {error}') from error
    by = f'magnet, {len(found.rows)} {"unknown" if box is not None else "tracked"} poses'
    suspects = tuple(int(given[k]) + FIRST_ROW for k in found.suspect_poses)
    return GeometrySurvey(
        stated, calibrated_network(known, found, date, by), found, given[found.rows] + FIRST_ROW,
        suspects, len(field), tuple(_silent_axes(stated, field)))


def corrected(network: SensorNetwork, readings: FloatArray) -> FloatArray:
    """Readings (K, n, 3) [T] as the stage Calibrate has them before it removes the background."""
    out = np.array(readings, dtype=float)
    for j, (offset, C) in enumerate(zip(network.offset, network.correction, strict=True)):
        if offset is not None:
            out[:, j] -= offset
        if C is not None:
            missing = np.isnan(out[:, j])
            field = np.where(missing, 0.0, out[:, j]) @ C.T
            # An axis is missing where one is that it needs.
            out[:, j] = np.where(missing @ (C != 0.0).T, np.nan, field)
    return out


def calibrated_network(network: SensorNetwork, geometry: NetworkGeometry, date: str,
                       by: str) -> SensorNetwork:
    """The network to be written: positions, orientations, gains and biases as found.

    A reading is gain * field + bias; the stage Calibrate corrects first and takes the background
    from what it has corrected, so that gain, bias and noise are those of corrected readings. A
    sensor that was never heard stays as it was.
    """
    found = geometry.network
    columns = {name: list(getattr(network, name)) for name in (
        'noise_std', 'background', 'correction', 'orientation_std', 'calibrated')}
    for j, gain in enumerate(geometry.gain):
        if np.isnan(geometry.bias[j]).all():
            continue
        was = network.correction[j]
        columns['correction'][j] = (np.eye(3) if was is None else was) / gain
        columns['background'][j] = (None if found.background[j] is None
                                    else found.background[j] / gain)
        if network.noise_std[j] is not None:
            columns['noise_std'][j] = network.noise_std[j] / abs(gain)
        std = _world_std(geometry, j)
        if (std > MIN_TURN).all():
            columns['orientation_std'][j] = std
        before = network.calibrated[j]
        columns['calibrated'][j] = network.marked(
            j, date, by, np.nan if before is None else before.clock_offset_std)
    changes: dict[str, Any] = {name: tuple(column) for name, column in columns.items()}
    return replace(network, positions=found.positions, R_ws=found.R_ws, **changes)


def _world_std(geometry: NetworkGeometry, j: int) -> FloatArray:
    """(3,) [rad] how far sensor `j` may be turned about the world's axes."""
    # Its rotation is the third block of its ten numbers: bias, gain, rotation, position.
    turn = slice(10 * j + 4, 10 * j + 7)
    R = geometry.network.R_ws[j]
    std: FloatArray = np.sqrt(np.diagonal(R @ geometry.covariance[turn, turn] @ R.T))
    return std


def _with_noise(network: SensorNetwork, noise_std: float | None) -> SensorNetwork:
    """The network, `noise_std` [T] where it says nothing; None changes nothing."""
    if noise_std is None:
        return network
    return replace(network, noise_std=tuple(
        np.full(3, float(noise_std)) if std is None else std for std in network.noise_std))


def _silent_axes(network: SensorNetwork, field: FloatArray) -> Iterator[tuple[str, str]]:
    """(sensor, axes) of sensors of which some axes, but not all, never reported."""
    silent: BoolArray = np.all(np.isnan(field), axis=0)
    for name, axes in zip(network.names, silent, strict=True):
        if axes.any() and not axes.all():
            yield name, ' and '.join(a for a, s in zip('xyz', axes, strict=True) if s)
