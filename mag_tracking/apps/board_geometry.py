"""Geometry calibration of a sensor board, for `mag-tracking calibrate board`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.network_fit import GeometrySettings
from mag_tracking.calibration.network_geometry import (
    NetworkGeometry,
    calibrate_geometry,
    calibrate_geometry_blind,
)
from mag_tracking.errors import NetworkError, RecordingError
from mag_tracking.network import SensorNetwork
from mag_tracking.quantities import quantity
from mag_tracking.recording.pose_table import (
    read_pose_table,
    read_readings,
    read_sensor_positions,
)

ASSUMED_NOISE = 1e-7
"""Noise assumed for sensors without a configured noise [T]. Near a magnet, the error of the
field model is larger."""

MIN_ROTATION_STD = 1e-7
"""Standard deviation below which an orientation is considered fixed, not estimated [rad]."""

FIRST_ROW = 2
"""Row number of the first pose in the table; the header is row 1."""


@dataclass(frozen=True)
class GeometrySurvey:
    """Result of the geometry calibration of a board."""

    nominal: SensorNetwork
    """Network before the calibration, including the assumed noise."""
    network: SensorNetwork
    """Calibrated network; invalid if the estimation has not converged."""
    geometry: NetworkGeometry
    """Result of the estimation."""
    rows: IntArray
    """(K,) table rows of the poses used."""
    suspect_rows: tuple[int, ...]
    """Table rows of inconsistent poses."""
    n_poses: int
    """Number of poses in the table."""
    silent_axes: tuple[tuple[str, str], ...]
    """(sensor, axes without readings) for each sensor that reports some axes but not all."""

    @property
    def rotation_angle(self) -> FloatArray:
        """Angle between nominal and estimated orientation of each sensor, (n,) rad."""
        trace: FloatArray = np.einsum('nij,nij->n', self.nominal.R_ws, self.network.R_ws)
        return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def board_of(path: str | PathLike[str]) -> SensorNetwork:
    """Network of uncalibrated sensors from a CSV table of positions x, y, z [m].

    They are named `mag_0`, `mag_1`, ... and aligned with the axes.
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
    """Estimate the geometry of a network from its readings for many poses of a magnet.

    The sensors of the nominal network are in the order of the columns of `table`
    (`read_pose_table`); its offsets and corrections are applied. `moment` is in A m². With the
    corners `box` (low, high) [m] around the magnet, the poses are estimated, and the table needs
    only readings. `noise_std` [T], by default `ASSUMED_NOISE`, is that of sensors without a
    configured noise and is stored only if given. Raises RecordingError if the table does not match
    the network or does not suffice.
    """
    if box is None:
        readings, positions, axes = read_pose_table(table)
    else:
        readings = read_readings(table)
    if readings.shape[1] != len(network):
        raise RecordingError(f'{table}: readings of {quantity(readings.shape[1], "sensor")}, but '
                             f'the network has {len(network)}')
    network_with_noise = _with_noise(network, noise_std)
    nominal = _with_noise(network_with_noise, ASSUMED_NOISE)
    field = corrected(nominal, readings)
    # Poses without readings are removed here or, for unknown poses, by the estimation.
    pose_indices = np.arange(len(field)) if box is not None else np.flatnonzero(
        ~np.isnan(field).all(axis=(1, 2)))
    try:
        if box is not None:
            low, high = (np.asarray(corner, dtype=float) for corner in box)
            geometry = calibrate_geometry_blind(nominal, field, moment, low, high, settings)
        else:
            geometry = calibrate_geometry(nominal, field[pose_indices], positions[pose_indices],
                                          axes[pose_indices], moment, settings)
    except ValueError as error:
        raise RecordingError(f'{table}: {error}') from error
    method = f'magnet, {len(geometry.rows)} {"unknown" if box is not None else "tracked"} poses'
    suspects = tuple(int(pose_indices[k]) + FIRST_ROW for k in geometry.suspect_poses)
    return GeometrySurvey(
        nominal, calibrated_network(network_with_noise, geometry, date, method), geometry,
        pose_indices[geometry.rows] + FIRST_ROW, suspects, len(field),
        tuple(_silent_axes(nominal, field)))


def corrected(network: SensorNetwork, readings: FloatArray) -> FloatArray:
    """Apply the offsets and corrections of a network to readings (K, n, 3), T, sensor frames, as
    the stage Calibrate does; the background remains."""
    corrected_readings = np.array(readings, dtype=float)
    for j, (offset, C) in enumerate(zip(network.offset, network.correction, strict=True)):
        if offset is not None:
            corrected_readings[:, j] -= offset
        if C is not None:
            is_missing = np.isnan(corrected_readings[:, j])
            field = np.where(is_missing, 0.0, corrected_readings[:, j]) @ C.T
            # A corrected axis is missing if any axis that contributes to it is missing.
            corrected_readings[:, j] = np.where(is_missing @ (C != 0.0).T, np.nan, field)
    return corrected_readings


def calibrated_network(network: SensorNetwork, geometry: NetworkGeometry, date: str,
                       method: str) -> SensorNetwork:
    """Network with the estimated positions, orientations, gains and biases.

    A reading is gain * field + bias. The stage Calibrate applies the correction before it removes
    the background, so the stored background and noise refer to corrected readings. A sensor without
    readings is not changed.
    """
    estimated_network = geometry.network
    columns = {name: list(getattr(network, name)) for name in (
        'noise_std', 'background', 'correction', 'orientation_std', 'calibrated')}
    for j, gain in enumerate(geometry.gain):
        if np.isnan(geometry.bias[j]).all():
            continue
        previous_correction = network.correction[j]
        columns['correction'][j] = (np.eye(3) if previous_correction is None
                                    else previous_correction) / gain
        columns['background'][j] = (None if estimated_network.background[j] is None
                                    else estimated_network.background[j] / gain)
        if network.noise_std[j] is not None:
            columns['noise_std'][j] = network.noise_std[j] / abs(gain)
        std = _world_std(geometry, j)
        if (std > MIN_ROTATION_STD).all():
            columns['orientation_std'][j] = std
        record = network.calibrated[j]
        columns['calibrated'][j] = network.calibration_record(
            j, date, method, np.nan if record is None else record.clock_offset_std)
    changes: dict[str, Any] = {name: tuple(column) for name, column in columns.items()}
    return replace(network, positions=estimated_network.positions, R_ws=estimated_network.R_ws,
                   **changes)


def _world_std(geometry: NetworkGeometry, j: int) -> FloatArray:
    """Standard deviations (3,) [rad] of the orientation of sensor `j` about the world axes."""
    # The ten parameters of a sensor are bias, gain, rotation and position.
    rotation = slice(10 * j + 4, 10 * j + 7)
    R = geometry.network.R_ws[j]
    std: FloatArray = np.sqrt(np.diagonal(R @ geometry.covariance[rotation, rotation] @ R.T))
    return std


def _with_noise(network: SensorNetwork, noise_std: float | None) -> SensorNetwork:
    """Return `network` with `noise_std` [T], unless None, for sensors whose noise is unknown."""
    if noise_std is None:
        return network
    return replace(network, noise_std=tuple(
        np.full(3, float(noise_std)) if std is None else std for std in network.noise_std))


def _silent_axes(network: SensorNetwork, field: FloatArray) -> Iterator[tuple[str, str]]:
    """Yield (sensor, axes without readings) for each sensor that reports some axes but not all."""
    silent: BoolArray = np.all(np.isnan(field), axis=0)
    for name, axes in zip(network.names, silent, strict=True):
        if axes.any() and not axes.all():
            yield name, ' and '.join(a for a, s in zip('xyz', axes, strict=True) if s)
