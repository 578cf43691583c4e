"""Faults and poor sensors for any recording: each function modifies `Readings`.

    readings = apply(readings, steps(1e-7), covariance(1e-2), beginning_cut(5.0))
"""

import dataclasses

import numpy as np

from mag_tracking.units import NS


def apply(readings, *faults):
    """Apply faults one after the other."""
    for fault in faults:
        readings = fault(readings)
    return readings


def _with(readings, field):
    return dataclasses.replace(readings, field=field)


def _seconds(readings):
    """(n,) [s] Time since the first reading."""
    return (readings.stamp_ns - readings.stamp_ns.min()) / NS


def _of(readings, sensor):
    """(n,) Whether a reading belongs to `sensor`; all for None."""
    if sensor is None:
        return np.ones(len(readings), dtype=bool)
    return np.array(readings.sensor_names()) == sensor


def covariance(variance):
    """Every message states this variance [T²]; 0 and -1 mean unknown, as in ROS messages."""
    def spoil(readings):
        if variance in (0.0, -1.0):
            return dataclasses.replace(readings, covariance=None)
        C = np.repeat(np.diag(np.full(3, variance))[None], len(readings), axis=0)
        return dataclasses.replace(readings, covariance=C)
    return spoil


def steps(size, sensor=None):
    """Quantise readings in steps of `size` [T]."""
    def spoil(readings):
        coarse = size * np.round(readings.field / size)
        return _with(readings, np.where(_of(readings, sensor)[:, None], coarse, readings.field))
    return spoil


def glitches(share, size, seed=0):
    """A `share` of the readings has an error of up to `size` [T] on one axis: bus errors."""
    def spoil(readings):
        rng, field = np.random.default_rng(seed), readings.field.copy()
        hit = np.flatnonzero(rng.random(len(readings)) < share)
        field[hit, rng.integers(0, 3, len(hit))] += \
            size * rng.uniform(0.3, 1.0, len(hit)) * rng.choice([-1.0, 1.0], len(hit))
        return _with(readings, field)
    return spoil


def clipped(share):
    """Each axis of each sensor is clipped at `share` of its largest excursion."""
    def spoil(readings):
        field = readings.field.copy()
        for j in range(len(readings.names)):
            mine = readings.sensor == j
            for a in range(3):
                y = field[mine, a]
                level = np.median(y[~np.isnan(y)]) if not np.isnan(y).all() else 0.0
                reach = share * np.max(np.abs(y - level), where=~np.isnan(y), initial=0.0)
                field[mine, a] = np.clip(y, level - reach, level + reach)
        return _with(readings, field)
    return spoil


def only_axes(axes):
    """Axes other than e.g. 'xz' are missing."""
    def spoil(readings):
        field = readings.field.copy()
        field[:, [k for k, a in enumerate('xyz') if a not in axes]] = np.nan
        return _with(readings, field)
    return spoil


def only_sensor(sensor):
    """All other sensors are missing."""
    return lambda readings: readings.part(_of(readings, sensor))


def dropped(share, seed=0):
    """A `share` of the readings is lost."""
    def spoil(readings):
        return readings.part(np.random.default_rng(seed).random(len(readings)) >= share)
    return spoil


def thinned(every):
    """Keep one in `every` readings of each sensor."""
    def spoil(readings):
        keep = np.zeros(len(readings), dtype=bool)
        for j in range(len(readings.names)):
            keep[np.flatnonzero(readings.sensor == j)[::every]] = True
        return readings.part(keep)
    return spoil


def delayed(sensor, seconds):
    """The clock of a sensor is behind by `seconds`."""
    def spoil(readings):
        stamp = readings.stamp_ns + np.where(_of(readings, sensor), int(seconds * NS), 0)
        order = np.argsort(stamp, kind='stable')
        return dataclasses.replace(readings, stamp_ns=stamp).part(order)
    return spoil


def beginning_cut(seconds):
    """The recording begins later by `seconds`."""
    return lambda readings: readings.part(_seconds(readings) >= seconds)


def vehicle_at_start(source, begin, seconds):
    """Add what `source` recorded from `begin` [s] for `seconds`, above its median, at the start."""
    def spoil(readings):
        field, t, t_source = readings.field.copy(), _seconds(readings), _seconds(source)
        for j, name in enumerate(readings.names):
            mine = (readings.sensor == j) & (t < seconds)
            of_source = _of(source, name)
            level = np.median(source.field[of_source], axis=0)
            for a in range(3):
                field[mine, a] += np.interp(t[mine] + begin, t_source[of_source],
                                            source.field[of_source, a] - level[a])
        return _with(readings, field)
    return spoil


def wrong_sign(sensor, axis):
    """The sign of an axis of a sensor is inverted."""
    def spoil(readings):
        field = readings.field.copy()
        field[_of(readings, sensor), 'xyz'.index(axis)] *= -1.0
        return _with(readings, field)
    return spoil


def hum(amplitude, frequency=50.0):
    """Power line: `amplitude` (3,) [T] at `frequency` [Hz]."""
    def spoil(readings):
        phase = 2.0 * np.pi * frequency * _seconds(readings)
        return _with(readings, readings.field + np.sin(phase)[:, None] * np.asarray(amplitude))
    return spoil


def drift(rate, sensor=None):
    """The background drifts by `rate` [T/s] on all axes."""
    def spoil(readings):
        added = rate * _seconds(readings) * _of(readings, sensor)
        return _with(readings, readings.field + added[:, None])
    return spoil


def temperature_step(size, at, time_constant=3.0, sensor=None):
    """From `at` [s] the field of a sensor approaches an offset of `size` [T] exponentially."""
    def spoil(readings):
        since = np.maximum(_seconds(readings) - at, 0.0)
        added = size * -np.expm1(-since / time_constant) * _of(readings, sensor)
        return _with(readings, readings.field + added[:, None])
    return spoil
