"""The records that flow: frozen, SI units, time as integer nanoseconds.

A missing axis or sensor is NaN. Arrays in a record are not to be changed.
"""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, slots=True)
class MagSample:
    """One reading of one sensor."""

    stamp_ns: int
    sensor: str
    field: np.ndarray
    """(3,) [T], sensor frame; after calibration the background is removed."""
    covariance: np.ndarray | None = None
    """(3, 3) [T^2], sensor frame; None = unknown."""


@dataclass(frozen=True, slots=True)
class AccelerationSample:
    """One reading of a sensor's accelerometer."""

    stamp_ns: int
    sensor: str
    acceleration: np.ndarray
    """(3,) [m/s^2], sensor frame; at rest it points up."""


@dataclass(frozen=True, slots=True)
class FieldFrame:
    """One look of the whole network."""

    stamp_ns: int
    field: np.ndarray
    """(n_sensors, 3) [T], sensor frames, background removed."""
    covariance: np.ndarray
    """(n_sensors, 3, 3) [T^2] of `field`; rows of a missing sensor are NaN."""
    n_samples: np.ndarray
    """(n_sensors,) samples averaged; 0 = missing."""
    time_offset: np.ndarray
    """(n_sensors,) [s] mean time of a sensor's samples, from `stamp_ns`; 0 where it is missing."""
    target_present: bool = False
    """The detector's verdict; false before detection."""
    statistic: float = float('nan')
    """Whitened energy, chi-square under noise; NaN before detection."""
    degrees_of_freedom: int = 0


@dataclass(frozen=True, slots=True)
class Detection:
    """The network began (onset) or ceased to see a target."""

    stamp_ns: int
    id: int
    onset: bool
    statistic: float
    degrees_of_freedom: int
    threshold: float
    false_alarm_probability: float
    strongest_sensor: str


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One member of the bank, as published."""

    arrival: str
    weight: float
    position: np.ndarray
    """(3,) [m], world."""
    velocity: np.ndarray
    """(3,) [m/s], world."""
    covariance: np.ndarray
    """(6, 6) of position and velocity."""
    moment: np.ndarray
    """(3,) [A m^2], world."""
    kind: str
    """The kind of target that it assumed; empty for a magnet."""


@dataclass(frozen=True, slots=True)
class SmoothedPose:
    """A target at one time, by what came before it and after."""

    stamp_ns: int
    id: int
    """Of the track."""
    position: np.ndarray
    """(3,) [m], world."""
    velocity: np.ndarray
    """(3,) [m/s], world."""
    covariance: np.ndarray
    """(6, 6) of position and velocity, world."""
    orientation: np.ndarray
    """(4,) quaternion xyzw, body to world."""
    orientation_covariance: np.ndarray
    """(3, 3) [rad^2], small rotations about the fixed world axes."""
    position_orientation_covariance: np.ndarray
    """(3, 3) [m rad]."""
    moment: np.ndarray
    """(3,) [A m^2], world."""
    moment_covariance: np.ndarray
    """(3, 3)."""
    kind: str
    length: float
    """[m] of the row of dipoles that the target is taken for; 0 for a point."""
    length_std: float
    """[m]; 0 for a point."""
    ambiguous: bool
    """Something else was still possible when it was smoothed."""
    complete: bool
    """All of the track was used; else what came within a fixed lag."""


@dataclass(frozen=True, slots=True)
class Track:
    """A target at one time: the best hypothesis and what is known of the others."""

    stamp_ns: int
    id: int
    ended: bool
    position: np.ndarray
    """(3,) [m], world."""
    velocity: np.ndarray
    """(3,) [m/s], world."""
    covariance: np.ndarray
    """(6, 6) of position and velocity, world."""
    orientation: np.ndarray
    """(4,) quaternion xyzw, body to world."""
    orientation_covariance: np.ndarray
    """(3, 3) [rad^2], small rotations about the fixed world axes."""
    position_orientation_covariance: np.ndarray
    """(3, 3) [m rad]."""
    moment: np.ndarray
    """(3,) [A m^2], world."""
    moment_covariance: np.ndarray
    """(3, 3)."""
    existence: float
    weight: float
    """Of the published hypothesis, 0..1."""
    nis: float
    """Normalised innovation squared of the published hypothesis; NaN without a measurement."""
    nis_by_sensor: np.ndarray
    """(n_sensors,) its parts, each given the sensors before it; NaN of a missing sensor."""
    degrees_of_freedom: int
    arrival: str
    kind: str
    """Of target, that of the published hypothesis; empty for a magnet."""
    kind_weight: float
    """Of all hypotheses of that kind, 0..1."""
    length: float
    """[m] of the row of dipoles that the target is taken for; 0 for a point."""
    length_std: float
    """[m]; 0 for a point."""
    ambiguous: bool
    unobservable: tuple[bool, ...]
    """(6): x, y, z, and rotation about the body's x, y, z."""
    predicted: np.ndarray
    """(n_sensors, 3) [T], sensor frames: the frame's field as the published hypothesis has it,
    without what it takes for errors of its model."""
    mounting: np.ndarray
    """(n_sensors, 3) [rad] angles as in `physics.mounting`; (0, 3) where they are not estimated."""
    mounting_covariance: np.ndarray
    """(n_sensors, 3, 3) [rad^2], or (0, 3, 3)."""
    hypotheses: tuple[Hypothesis, ...] = field(default=())
    """Heaviest first; the published one is among them."""

    @property
    def mounting_std(self):
        """(n_sensors, 3) [rad], or (0, 3)."""
        return np.sqrt(np.einsum('jii->ji', self.mounting_covariance))
