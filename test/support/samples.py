"""Single samples, which tests modify and reorder, and batches of readings made from them."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.messages.schema import magnetic_field_dicts
from mag_tracking.records import Readings
from mag_tracking.simulation import scenario


@dataclass(frozen=True)
class MagSample:
    """Reading of one sensor; covariance None = unknown."""

    stamp_ns: int
    sensor: str
    field: np.ndarray
    covariance: np.ndarray | None = None


def one(sample):
    """Batch of one `MagSample`."""
    return Readings.single(sample.sensor, sample.stamp_ns, np.asarray(sample.field, dtype=float),
                           sample.covariance)


def batch(samples):
    """Batch of [`MagSample`]."""
    return Readings.joined([one(s) for s in samples])


def samples_of(*batches):
    """[`MagSample`] of batches."""
    out = []
    for readings in batches:
        C = readings.covariance
        out += [MagSample(stamp, name, readings.field[k],
                          None if C is None or np.isnan(C[k]).all() else C[k])
                for k, (name, stamp) in enumerate(zip(
                    readings.sensor_names(), readings.stamp_ns.tolist(), strict=True))]
    return out


def fed(stage, sample):
    """[`MagSample`] that a `Calibrate` returns for a `MagSample`."""
    return samples_of(*stage.feed(one(sample)))


def flushed(stage):
    """[`MagSample`] that a `Calibrate` has held."""
    return samples_of(*stage.flush())


def recorded(reader):
    """[`MagSample`] of a `SampleReader`."""
    return samples_of(*reader.readings())


def simulate(*arguments, **named):
    """`scenario.simulate` that returns [`MagSample`]."""
    readings, *truth = scenario.simulate(*arguments, **named)
    return samples_of(readings), *truth


def sample_dict(sample, frame):
    """sensor_msgs/MagneticField of a `MagSample`."""
    ((_, content),) = magnetic_field_dicts(one(sample), frame)
    return content


def field_dict(stamp_ns, sensor, field):
    """sensor_msgs/MagneticField of one reading, without a covariance."""
    ((_, content),) = magnetic_field_dicts(Readings.single(sensor, stamp_ns, field), sensor)
    return content
