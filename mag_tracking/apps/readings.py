"""Readings as arrays: of a recording, or from arrays of the caller's own."""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mag_tracking.arrays import BoolArray
from mag_tracking.errors import ReadingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import read_network
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import Readings
from mag_tracking.report.metrics import Truth
from mag_tracking.units import LATEST_NS, NS

MAX_DELAY_S = 10.0
"""[s] Readings that are further behind are taken for unsorted, not for delayed."""


@dataclass(frozen=True)
class RecordedReadings:
    """The content of a recording in arrays."""

    readings: Readings
    """In the order in which they were logged; `names` are those of the network."""
    truth: dict[str, Truth]
    """{target: (stamps (n,) [ns], positions (n, 3) [m], quaternions (n, 4) xyzw)}; empty where the
    recording has no ground truth."""
    rejected: dict[str, int]
    """{cause: number} of messages without a usable reading."""
    lost: dict[str, int]
    """{damage: number} of what could not be read."""
    missing_topics: tuple[str, ...]
    """Topics of the network that are not in the recording."""

    def __repr__(self) -> str:
        return (f'RecordedReadings({len(self.readings)} readings of '
                f'{", ".join(self.readings.names)}; truth: {", ".join(self.truth) or "none"})')


def network_of(network: SensorNetwork | str | PathLike[str]) -> SensorNetwork:
    """The network itself, or that in a file; raises NetworkError."""
    return network if isinstance(network, SensorNetwork) else read_network(network)


def read_recording(path: str | PathLike[str],
                   network: SensorNetwork | str | PathLike[str]) -> RecordedReadings:
    """Read all readings of a network and the ground truth from a recording.

    Parameters
    ----------
    path : path
        An .mcap, .db3 or .bag file, or a rosbag2 folder.
    network : SensorNetwork or path of a network file

    Returns
    -------
    RecordedReadings

    Raises
    ------
    RecordingError
        If there is no readable recording, or it has none of the network's topics.
    NetworkError
        If the network file is not valid.
    """
    network = network_of(network)
    recording = Recording(path)
    reader = SampleReader(recording, network)
    found = Readings.joined(reader.readings())
    rows = found.rows({name: i for i, name in enumerate(network.names)})
    return recorded(recording, reader, Readings(network.names, rows, found.stamp_ns, found.field,
                                                found.covariance))


def recorded(recording: Recording, reader: SampleReader, readings: Readings) -> RecordedReadings:
    """The `readings` with what else `reader` found in the recording by now."""
    return RecordedReadings(readings, reader.truth_arrays(), dict(reader.rejected),
                            dict(recording.losses), tuple(reader.missing_topics()))


def readings_from_arrays(sensor: Sequence[str], stamp_ns: ArrayLike, field: ArrayLike,
                         covariance: ArrayLike | None = None) -> Readings:
    """Readings from arrays, for `track`.

    Parameters
    ----------
    sensor : (n,) str
        Name of the sensor of each reading, as in the network file.
    stamp_ns : (n,) int, ns
        Time of measurement, sorted; several sensors may share one.
    field : (n, 3) array, T, sensor frame
        NaN = axis not measured.
    covariance : (n, 3, 3) array, T^2, sensor frame, optional
        A matrix of NaN = unknown.

    Returns
    -------
    Readings

    Raises
    ------
    ReadingsError
        If shapes or types are wrong, or the timestamps are not sorted.
    """
    if isinstance(sensor, str):
        raise ReadingsError(f'sensor: expected a name for each reading; got the text {sensor!r}')
    names = tuple(dict.fromkeys(str(name) for name in sensor))
    rows = {name: i for i, name in enumerate(names)}
    fields, C = _filled(field), None if covariance is None else _filled(covariance)
    readings = _checked(Readings(
        names, np.array([rows[str(name)] for name in sensor], dtype=np.int64),
        np.asarray(stamp_ns), fields if fields.size else fields.reshape(0, 3), C))
    check_order(readings, 0.0)
    return readings


def _filled(values: ArrayLike) -> NDArray[Any]:
    """The array, with NaN where it is masked."""
    if isinstance(values, np.ma.MaskedArray):
        return np.where(values.mask, np.nan, values.data)
    return np.asarray(values)


def checked_readings(readings: Readings, network: SensorNetwork) -> Readings:
    """The readings with arrays of the types that the stages expect.

    Parameters
    ----------
    readings : Readings
    network : SensorNetwork

    Returns
    -------
    Readings

    Raises
    ------
    ReadingsError
        If shapes or types are wrong, or all readings are of sensors that the network does not have.
    """
    readings = _checked(readings)
    if len(readings) and not set(readings.names) & set(network.names):
        raise ReadingsError(f'readings of {", ".join(readings.names)}, but the network has '
                            f'{", ".join(network.names)}')
    return readings


def _checked(readings: Readings) -> Readings:
    """The readings in int64 and float64; raises ReadingsError for another shape or type."""
    n, kinds = len(readings), {'sensor': 'iu', 'stamp_ns': 'iu', 'field': 'iuf',
                               'covariance': 'iuf'}
    for name, allowed in kinds.items():
        values = getattr(readings, name)
        if values is None:
            continue
        if isinstance(values, np.ma.MaskedArray):
            raise ReadingsError(f'{name}: a masked array; use NaN for what is missing')
        values = np.asarray(values)
        # An empty list has no integers.
        if values.dtype.kind not in allowed and values.size:
            wanted = 'floats' if 'f' in allowed else (
                'integers, nanoseconds' if name == 'stamp_ns' else 'integers, rows of names')
            raise ReadingsError(f'{name}: expected {wanted}; got {values.dtype}')
    stamps = np.asarray(readings.stamp_ns)
    if n and not -LATEST_NS <= int(stamps.min()) <= int(stamps.max()) <= LATEST_NS:
        raise ReadingsError(f'stamp_ns: {stamps.min()} .. {stamps.max()} is outside '
                            f'{-LATEST_NS} .. {LATEST_NS}: nanoseconds since 1970?')
    sensor = np.asarray(readings.sensor, dtype=np.int64)
    if n and not 0 <= sensor.min() <= sensor.max() < len(readings.names):
        raise ReadingsError(f'sensor: {sensor.min()} .. {sensor.max()} is outside 0 .. '
                            f'{len(readings.names) - 1}, the rows of names')
    C = readings.covariance
    return Readings(tuple(readings.names), sensor, np.asarray(readings.stamp_ns, dtype=np.int64),
                    np.asarray(readings.field, dtype=float),
                    None if C is None else np.asarray(C, dtype=float))


def check_order(readings: Readings, tolerance: float = MAX_DELAY_S) -> None:
    """Raise ReadingsError where a reading is `tolerance` [s] older than one before it."""
    if not len(readings):
        return
    behind = np.maximum.accumulate(readings.stamp_ns) - readings.stamp_ns
    late: BoolArray = behind > tolerance * NS
    if late.any():
        k = int(np.argmax(late))
        raise ReadingsError(
            f'stamp_ns: reading {k} ({readings.names[readings.sensor[k]]}) is '
            f'{behind[k] / NS:.3g} s older than one before it; sort the readings '
            "(np.argsort(stamp_ns, kind='stable')), and track what was recorded in another run "
            'by itself')
