"""Readings as arrays, from a recording or from arrays of the user."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mag_tracking.analysis.track_errors import Truth
from mag_tracking.apps.user_tables import (
    is_table,
    nanoseconds,
    readings_of_arrays,
    readings_of_table,
)
from mag_tracking.arrays import BoolArray
from mag_tracking.errors import ReadingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import read_network
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import Readings
from mag_tracking.run import ArraySource, RecordingSource, Source
from mag_tracking.units import LATEST_NS, NS

UserSource: TypeAlias = Any
"""Readings, RecordedReadings, path of a recording, DataFrame, or {sensor: (times, fields)}."""
MAX_DELAY_S = 10.0
"""Delay above which a reading is considered unsorted rather than delayed [s]."""


@dataclass(frozen=True)
class RecordedReadings:
    """Content of a recording as arrays."""

    readings: Readings
    """Readings in the order of logging; `names` are the sensors of the network."""
    truth: dict[str, Truth]
    """{target: (timestamps (n,) ns, positions (n, 3) m, quaternions (n, 4) xyzw)}; empty without
    ground truth."""
    rejected: dict[str, int]
    """Messages without a usable reading: {cause: number}."""
    lost: dict[str, int]
    """Unreadable parts of the recording: {damage: number}."""
    missing_topics: tuple[str, ...]
    """Topics of the network that are not in the recording."""

    def __repr__(self) -> str:
        return (f'RecordedReadings({quantity(len(self.readings), "reading")} of '
                f'{", ".join(self.readings.names)}; truth: {", ".join(self.truth) or "none"})')


def network_of(network: SensorNetwork | str | PathLike[str]) -> SensorNetwork:
    """Return a network, or read it from a file; raises NetworkError."""
    return network if isinstance(network, SensorNetwork) else read_network(network)


def read_recording(path: str | PathLike[str],
                   network: SensorNetwork | str | PathLike[str]) -> RecordedReadings:
    """Read the readings of a network and the ground truth from a recording.

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
        If the recording cannot be read, or has none of the network's topics.
    NetworkError
        If the network file is invalid.
    """
    network = network_of(network)
    recording = Recording(path)
    reader = SampleReader(recording, network)
    recorded = Readings.joined(reader.readings())
    sensor = recorded.rows({name: i for i, name in enumerate(network.names)})
    return recorded_readings(recording, reader, Readings(
        network.names, sensor, recorded.stamp_ns, recorded.field, recorded.covariance))


def recorded_readings(recording: Recording, reader: SampleReader,
                      readings: Readings) -> RecordedReadings:
    """Combine readings with the ground truth, losses and rejections of a recording at its end."""
    return RecordedReadings(readings, reader.truth_arrays(), dict(reader.rejected),
                            dict(recording.losses), tuple(reader.missing_topics()))


def source_of(source: UserSource, network: SensorNetwork, time_unit: str | None = None) -> Source:
    """Source for `run`: a recording, which need not fit into memory, or readings."""
    if is_table(source):
        source = readings_of_table(source, time_unit, network.names)
    elif isinstance(source, Mapping):
        source = readings_of_arrays(source, time_unit)
    elif time_unit is not None:
        raise ReadingsError('time_unit: only for the times of a DataFrame or of arrays')
    if isinstance(source, Readings):
        check_order(source)
        readings = checked_readings(source, network)
        present = {readings.names[j] for j in np.unique(readings.sensor)}
        return ArraySource(readings, topics=[topic for name, topic in zip(
            network.names, network.absolute_topics, strict=True) if name not in present])
    if isinstance(source, RecordedReadings):
        return ArraySource(checked_readings(source.readings, network), rejected=source.rejected,
                           lost=source.lost, topics=source.missing_topics)
    if isinstance(source, str | PathLike):
        return RecordingSource(Recording(source), network)
    raise ReadingsError('source: expected a path, Readings, a DataFrame or {sensor: (times, '
                        f'fields)}}, got {type(source).__name__}')


def readings_from_arrays(sensor: Sequence[str], stamp_ns: ArrayLike, field: ArrayLike,
                         covariance: ArrayLike | None = None,
                         time_unit: str | None = None) -> Readings:
    """Create readings from arrays, for `track`.

    Parameters
    ----------
    sensor : (n,) sequence of str
        Name of the sensor of each reading, as in the network file.
    stamp_ns : (n,) int array, ns, datetime64 array, or float array
        Timestamps in ascending order; sensors may have equal timestamps. Times without a time zone
        are in UTC.
    field : (n, 3) array, T, sensor frame
        Flux density; NaN marks an axis that was not measured.
    covariance : (n, 3, 3) array, T², sensor frame, optional
        Noise covariance; NaN if unknown.
    time_unit : 's', 'ms', 'us' or 'ns', optional
        Unit of `stamp_ns`; required for floats.

    Returns
    -------
    Readings

    Raises
    ------
    ReadingsError
        If shapes or types are wrong, or the timestamps are not sorted.
    """
    if isinstance(sensor, str):
        raise ReadingsError(f'sensor: expected one name per reading, got the string {sensor!r}')
    names = tuple(dict.fromkeys(str(name) for name in sensor))
    index_of = {name: i for i, name in enumerate(names)}
    fields, C = _with_nan(field), None if covariance is None else _with_nan(covariance)
    readings = _to_standard_types(Readings(
        names, np.array([index_of[str(name)] for name in sensor], dtype=np.int64),
        nanoseconds(stamp_ns, time_unit, 'stamp_ns'),
        fields if fields.size else fields.reshape(0, 3), C))
    check_order(readings, 0.0)
    return readings


def _with_nan(values: ArrayLike) -> NDArray[Any]:
    """Convert values to an array with NaN for masked elements."""
    if isinstance(values, np.ma.MaskedArray):
        return np.where(values.mask, np.nan, values.data)
    return np.asarray(values)


def checked_readings(readings: Readings, network: SensorNetwork) -> Readings:
    """Check readings and convert them to the array types that the stages expect.

    Raises ReadingsError if shapes or types are wrong, or no reading belongs to the network.
    """
    readings = _to_standard_types(readings)
    if len(readings) and not set(readings.names) & set(network.names):
        raise ReadingsError(f'no reading is from a sensor of the network: the readings are from '
                            f'{", ".join(readings.names)}, the sensors of the network are '
                            f'{", ".join(network.names)}')
    return readings


def _to_standard_types(readings: Readings) -> Readings:
    """Convert readings to int64 and float64; raises ReadingsError for a wrong shape or type."""
    n, kinds = len(readings), {'sensor': 'iu', 'stamp_ns': 'iu', 'field': 'iuf',
                               'covariance': 'iuf'}
    for name, allowed in kinds.items():
        values = getattr(readings, name)
        if values is None:
            continue
        if isinstance(values, np.ma.MaskedArray):
            raise ReadingsError(f'{name}: masked arrays are not supported; use NaN for missing '
                                'values')
        values = np.asarray(values)
        # NumPy converts an empty list to float.
        if values.dtype.kind not in allowed and values.size:
            expected = 'floats' if 'f' in allowed else (
                'integers, nanoseconds' if name == 'stamp_ns' else 'integers, indices into names')
            raise ReadingsError(f'{name}: expected {expected}, got {values.dtype}')
    stamps = np.asarray(readings.stamp_ns)
    if n and not -LATEST_NS <= int(stamps.min()) <= int(stamps.max()) <= LATEST_NS:
        raise ReadingsError(f'stamp_ns: {stamps.min()} .. {stamps.max()} is outside '
                            f'{-LATEST_NS} .. {LATEST_NS}; expected nanoseconds since 1970')
    sensor = np.asarray(readings.sensor, dtype=np.int64)
    if n and not 0 <= sensor.min() <= sensor.max() < len(readings.names):
        raise ReadingsError('sensor: expected indices into names (0 .. '
                            f'{len(readings.names) - 1}), got {sensor.min()} .. {sensor.max()}')
    C = readings.covariance
    return Readings(tuple(readings.names), sensor, np.asarray(readings.stamp_ns, dtype=np.int64),
                    np.asarray(readings.field, dtype=float),
                    None if C is None else np.asarray(C, dtype=float))


def check_order(readings: Readings, tolerance: float = MAX_DELAY_S) -> None:
    """Raise ReadingsError if a reading is older than a preceding one by more than `tolerance`
    [s]."""
    if not len(readings):
        return
    delay_ns = np.maximum.accumulate(readings.stamp_ns) - readings.stamp_ns
    late: BoolArray = delay_ns > tolerance * NS
    if late.any():
        k = int(np.argmax(late))
        raise ReadingsError(
            f'stamp_ns: reading {k} ({readings.names[readings.sensor[k]]}) is '
            f'{delay_ns[k] / NS:.3g} s older than an earlier reading; sort the readings '
            "(np.argsort(stamp_ns, kind='stable')), and track separate recordings separately")
