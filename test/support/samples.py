"""Individual samples, which tests modify and reorder, and conversion to batches of readings."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.messages.schema import magnetic_field_dicts
from mag_tracking.records import Readings
from support import scenario


@dataclass(frozen=True)
class MagSample:
    """Reading of one sensor; `covariance` is None if unknown."""

    stamp_ns: int
    sensor: str
    field: np.ndarray
    covariance: np.ndarray | None = None


def one(sample):
    """Convert a `MagSample` to a batch of one reading."""
    return Readings.single(sample.sensor, sample.stamp_ns, np.asarray(sample.field, dtype=float),
                           sample.covariance)


def batch(samples):
    """Convert a list of `MagSample` to a batch of readings."""
    return Readings.joined([one(s) for s in samples])


def samples_of(*batches):
    """Convert batches of readings to a list of `MagSample`."""
    out = []
    for readings in batches:
        C = readings.covariance
        out += [MagSample(stamp, name, readings.field[k],
                          None if C is None or np.isnan(C[k]).all() else C[k])
                for k, (name, stamp) in enumerate(zip(
                    readings.sensor_names(), readings.stamp_ns.tolist(), strict=True))]
    return out


def fed(stage, sample):
    """Feed a `MagSample` to a `Calibrate` stage; return a list of `MagSample`."""
    return samples_of(*stage.feed(one(sample)))


def flushed(stage):
    """Flush a `Calibrate` stage; return a list of `MagSample`."""
    return samples_of(*stage.flush())


def recorded(reader):
    """Read all samples of a `SampleReader`; return a list of `MagSample`."""
    return samples_of(*reader.readings())


def simulate(*arguments, **named):
    """Call `scenario.simulate`; return a list of `MagSample`, followed by the other results."""
    readings, *truth = scenario.simulate(*arguments, **named)
    return samples_of(readings), *truth


def sample_dict(sample, frame):
    """Content of the sensor_msgs/MagneticField message of a `MagSample`."""
    ((_, content),) = magnetic_field_dicts(one(sample), frame)
    return content


def field_dict(stamp_ns, sensor, field):
    """Content of a sensor_msgs/MagneticField message without a covariance."""
    ((_, content),) = magnetic_field_dicts(Readings.single(sensor, stamp_ns, field), sensor)
    return content
