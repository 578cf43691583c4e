"""Faults of sensors and streams for any recording. Each function returns a fault for `apply`.

    readings = apply(readings, steps(1e-7), covariance(1e-2), beginning_cut(5.0))
"""

import dataclasses

import numpy as np

from mag_tracking.units import NS


def apply(readings, *faults):
    """Apply faults to `Readings`, one after the other."""
    for fault in faults:
        readings = fault(readings)
    return readings


def _with(readings, field):
    return dataclasses.replace(readings, field=field)


def _seconds(readings):
    """Time of each reading since the first reading, (n,) s."""
    return (readings.stamp_ns - readings.stamp_ns.min()) / NS


def _of(readings, sensor):
    """Whether each reading belongs to `sensor`, (n,); None selects all."""
    if sensor is None:
        return np.ones(len(readings), dtype=bool)
    return np.array(readings.sensor_names()) == sensor


def covariance(variance):
    """Fault: every message has this variance [T²]; 0 and -1 mean unknown, as in ROS messages."""
    def modify(readings):
        if variance in (0.0, -1.0):
            return dataclasses.replace(readings, covariance=None)
        C = np.repeat(np.diag(np.full(3, variance))[None], len(readings), axis=0)
        return dataclasses.replace(readings, covariance=C)
    return modify


def steps(size, sensor=None):
    """Fault: readings of `sensor` (default: all) are quantised in steps of `size` [T]."""
    def modify(readings):
        coarse = size * np.round(readings.field / size)
        return _with(readings, np.where(_of(readings, sensor)[:, None], coarse, readings.field))
    return modify


def glitches(share, size, seed=0):
    """Fault: a fraction `share` of the readings has a bus error of up to `size` [T] on one axis."""
    def modify(readings):
        rng, field = np.random.default_rng(seed), readings.field.copy()
        faulty = np.flatnonzero(rng.random(len(readings)) < share)
        field[faulty, rng.integers(0, 3, len(faulty))] += \
            size * rng.uniform(0.3, 1.0, len(faulty)) * rng.choice([-1.0, 1.0], len(faulty))
        return _with(readings, field)
    return modify


def clipped(share):
    """Fault: each axis of each sensor is clipped at a fraction `share` of its largest excursion."""
    def modify(readings):
        field = readings.field.copy()
        for j in range(len(readings.names)):
            own = readings.sensor == j
            for a in range(3):
                y = field[own, a]
                level = np.median(y[~np.isnan(y)]) if not np.isnan(y).all() else 0.0
                limit = share * np.max(np.abs(y - level), where=~np.isnan(y), initial=0.0)
                field[own, a] = np.clip(y, level - limit, level + limit)
        return _with(readings, field)
    return modify


def only_axes(axes):
    """Fault: all axes except `axes` (such as 'xz') are missing."""
    def modify(readings):
        field = readings.field.copy()
        field[:, [k for k, a in enumerate('xyz') if a not in axes]] = np.nan
        return _with(readings, field)
    return modify


def only_sensor(sensor):
    """Fault: only the readings of `sensor` remain."""
    return lambda readings: readings.part(_of(readings, sensor))


def dropped(share, seed=0):
    """Fault: a fraction `share` of the readings is lost."""
    def modify(readings):
        return readings.part(np.random.default_rng(seed).random(len(readings)) >= share)
    return modify


def thinned(every):
    """Fault: only every `every`-th reading of each sensor is kept."""
    def modify(readings):
        keep = np.zeros(len(readings), dtype=bool)
        for j in range(len(readings.names)):
            keep[np.flatnonzero(readings.sensor == j)[::every]] = True
        return readings.part(keep)
    return modify


def delayed(sensor, seconds):
    """Fault: the timestamps of a sensor are later by `seconds`."""
    def modify(readings):
        stamp = readings.stamp_ns + np.where(_of(readings, sensor), int(seconds * NS), 0)
        order = np.argsort(stamp, kind='stable')
        return dataclasses.replace(readings, stamp_ns=stamp).part(order)
    return modify


def beginning_cut(seconds):
    """Fault: the first `seconds` of the recording are missing."""
    return lambda readings: readings.part(_seconds(readings) >= seconds)


def vehicle_at_start(source, begin, seconds):
    """Fault: the signal of the `Readings` `source` from `begin` [s] on is added to the first
    `seconds`."""
    def modify(readings):
        field, t, t_source = readings.field.copy(), _seconds(readings), _seconds(source)
        for j, name in enumerate(readings.names):
            own = (readings.sensor == j) & (t < seconds)
            of_source = _of(source, name)
            level = np.median(source.field[of_source], axis=0)
            for a in range(3):
                field[own, a] += np.interp(t[own] + begin, t_source[of_source],
                                           source.field[of_source, a] - level[a])
        return _with(readings, field)
    return modify


def wrong_sign(sensor, axis):
    """Fault: the sign of an axis of a sensor is inverted."""
    def modify(readings):
        field = readings.field.copy()
        field[_of(readings, sensor), 'xyz'.index(axis)] *= -1.0
        return _with(readings, field)
    return modify


def hum(amplitude, frequency=50.0):
    """Fault: a power line adds a field with `amplitude` (3,) [T] and `frequency` [Hz] at all
    sensors."""
    def modify(readings):
        phase = 2.0 * np.pi * frequency * _seconds(readings)
        return _with(readings, readings.field + np.sin(phase)[:, None] * np.asarray(amplitude))
    return modify


def drift(rate, sensor=None):
    """Fault: the background of `sensor` (default: all) drifts by `rate` [T/s] on all axes."""
    def modify(readings):
        added = rate * _seconds(readings) * _of(readings, sensor)
        return _with(readings, readings.field + added[:, None])
    return modify


def temperature_step(size, at, time_constant=3.0, sensor=None):
    """Fault: after `at` [s], the offset of `sensor` (default: all) approaches `size` [T]
    exponentially."""
    def modify(readings):
        since = np.maximum(_seconds(readings) - at, 0.0)
        added = size * -np.expm1(-since / time_constant) * _of(readings, sensor)
        return _with(readings, readings.field + added[:, None])
    return modify


def transformed(sensor, matrix):
    """Fault: the field of `sensor` (all if None) is multiplied by a gain or a matrix (3, 3)."""
    def modify(readings):
        changed = readings.field @ (np.eye(3) * matrix if np.isscalar(matrix) else matrix).T
        return _with(readings, np.where(_of(readings, sensor)[:, None], changed, readings.field))
    return modify


def offset(sensor, vector):
    """Fault: a constant `vector` (3,) [T] is added to the field of `sensor`."""
    def modify(readings):
        return _with(readings, readings.field + np.where(_of(readings, sensor)[:, None], vector,
                                                         0.0))
    return modify


def exchanged(first, second):
    """Fault: two sensors are connected to each other's topics."""
    def modify(readings):
        names = list(readings.names)
        a, b = names.index(first), names.index(second)
        sensor = readings.sensor.copy()
        sensor[readings.sensor == a], sensor[readings.sensor == b] = b, a
        return dataclasses.replace(readings, sensor=sensor)
    return modify
