"""Error bounds and detection probabilities of passing targets, for planning sensor positions.

The target is a point that moves on a straight line at constant speed, with the states [r, v, m].
The direction of its moment is unknown in advance; each result is computed for all `DIRECTIONS`.
The bounds follow TSP14 section IV and MITRE12 section 4, with unknown backgrounds.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.detection_theory import detection_probability, energy_threshold
from mag_tracking.physics.dipole import sensor_fields

DIRECTIONS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], *(
    np.array(d) / np.sqrt(3.0) for d in ((1, 1, 1), (1, 1, -1), (1, -1, 1), (-1, 1, 1)))])
"""(7, 3) directions of the moment. Opposite directions result in the same information."""
STATES = ('x', 'y', 'z', 'vx', 'vy', 'vz', 'mx', 'my', 'mz')
"""Names of the states [r, v, m]."""
MAX_FIELDS = 200_000
"""Maximum number of fields computed at once, to limit memory."""


@dataclass(frozen=True)
class PlannedTarget:
    """Target for which a network is planned."""

    moment: float
    """Magnitude of the moment [A m²]."""
    height: float
    """Height of the magnetic centre [m]."""
    speed: float
    """Speed [m/s]."""
    height_std: float = np.inf
    """Prior standard deviation of the height [m]; infinite if unknown."""
    climb_std: float = np.inf
    """Prior standard deviation of the vertical speed [m/s]; infinite if unknown."""
    moment_known: bool = True
    """Whether the magnitude of the moment has a prior, with a relative standard deviation of one.
    The direction is always unknown."""

    def prior(self) -> FloatArray:
        """Prior information matrix of [r, v, m].

        Returns
        -------
        (9, 9) array

        References
        ----------
        [MITRE12]_ eq. (28).
        """
        std = np.full(9, np.inf)
        std[2], std[5] = self.height_std, self.climb_std
        if self.moment_known:
            std[6:] = self.moment / np.sqrt(3.0)
        return np.diag(1.0 / std**2)


@dataclass(frozen=True)
class Sampling:
    """Sampling times and errors of the sensors."""

    period: float
    """Interval between frames [s]."""
    noise_std: FloatArray | float
    """(n_sensors,) [T] noise standard deviation per axis and frame, or one value for all."""
    field_error: float = 0.0
    """Error relative to the field due to clocks, mounting and model, treated as white noise. An
    error that is constant over n frames must be multiplied by the square root of n."""
    background_std: float = np.inf
    """Prior standard deviation of the backgrounds [T]; infinite if unknown."""
    half_window: float = 3.0
    """Duration of the track before, and also after, the evaluated point [s]."""
    max_frames: int = 60
    """Maximum number of computed frames; an even number is increased by one."""

    def times(self) -> tuple[FloatArray, float]:
        """Times of the computed frames, and the number of real frames per computed frame.

        Returns
        -------
        t : (k,) array, s
        weight : float
            Number of real frames per computed frame.
        """
        n = 2 * int(self.half_window / self.period) + 1
        k = min(n, self.max_frames // 2 * 2 + 1)
        t = np.linspace(-self.half_window, self.half_window, k, dtype=np.float64)
        return t, n / k


def pass_fields(positions: FloatArray, R_sw: FloatArray, target: PlannedTarget,
                sampling: Sampling, points: FloatArray,
                heading: float) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
    """Yield fields and Jacobians of passes through points, for each direction of the moment.

    `points` (n, 2) are in the world frame. Each item is a slice of `points` with n_p points, the
    fields (n_p, 7, k, n_sensors, 3) [T] at the k times of `sampling`, and their derivatives with
    respect to [r, v, m] at time zero, when the target is at the point.
    """
    t, _ = sampling.times()
    v = target.speed * np.array([np.cos(heading), np.sin(heading), 0.0])
    shape = len(DIRECTIONS), len(t)
    n_hypotheses = shape[0] * shape[1]
    # [r, v, m] at the point; the target is at r + t v.
    dr_dx, dm_dx = np.zeros((2, *shape, 3, 9))
    dr_dx[..., range(3), range(3)] = 1.0
    dr_dx[..., range(3), range(3, 6)] = t[:, None]
    dm_dx[..., range(3), range(6, 9)] = 1.0
    m = np.broadcast_to(target.moment * DIRECTIONS[:, None], (*shape, 3))
    step = max(1, MAX_FIELDS // (n_hypotheses * len(positions)))
    for first in range(0, len(points), step):
        chunk = points[first:first + step]
        n = len(chunk)
        r0 = np.column_stack([chunk, np.full(n, target.height)])
        states = (np.broadcast_to(a, (n, *shape, *a.shape[-tail:])) for a, tail in (
            (r0[:, None, None] + t[:, None] * v, 1), (m, 1), (dr_dx, 2), (dm_dx, 2)))
        h, H, _ = sensor_fields(positions, R_sw, *(
            a.reshape(n * n_hypotheses, 1, *a.shape[3:]).copy() for a in states))
        # At the position of a sensor, the field is singular. The sensor is not used in this frame.
        is_at_sensor = ~(np.isfinite(h).all(axis=-1) & np.isfinite(H).all(axis=(-2, -1)))
        h[is_at_sensor], H[is_at_sensor] = 0.0, 0.0
        yield (slice(first, first + n), h.reshape(n, *shape, -1, 3),
               H.reshape(n, *shape, len(positions), 3, 9))


def pass_information(positions: FloatArray, R_sw: FloatArray, target: PlannedTarget,
                     sampling: Sampling, points: FloatArray, heading: float) -> FloatArray:
    """Fisher information (n, 7, n_sensors, 9, 9) about [r, v, m] for a target at each point (n, 2).

    The backgrounds are eliminated, with their prior. TSP14 eq. (28), (40); MITRE12 eq. (17), (30).
    """
    _, frame_weight = sampling.times()
    result = np.empty((len(points), len(DIRECTIONS), len(positions), 9, 9))
    for part, h, H in pass_fields(positions, R_sw, target, sampling, points, heading):
        variance = (np.square(sampling.noise_std) + sampling.field_error**2 * np.einsum(
            'pdksa,pdksa->pdks', h, h)) / frame_weight
        weighted_jacobians = H / variance[..., None, None]
        J = np.einsum('pdksai,pdksaj->pdsij', weighted_jacobians, H, optimize=True)
        weighted_sum = weighted_jacobians.sum(axis=2)
        background_information = (1.0 / variance).sum(axis=2) + 1.0 / sampling.background_std**2
        result[part] = J - np.einsum('pdsai,pdsaj->pdsij', weighted_sum,
                                     weighted_sum) / background_information[..., None, None]
    return result


def bounds_of(information: FloatArray, prior: FloatArray) -> FloatArray:
    """Cramér-Rao bounds (..., 3) on the std of horizontal position, horizontal velocity and moment.

    Each is the root of summed variances; unobservable quantities have large bounds, at most 1e6 of
    their unit per axis. TSP14 eq. (42)-(45), with the trace in place of the norm; MITRE12 eq. (32).
    """
    J = information + prior + 1e-12 * np.eye(9)
    scale = np.sqrt(np.einsum('...ii->...i', J))
    P = np.linalg.inv(J / (scale[..., :, None] * scale[..., None, :]))
    variance = np.einsum('...ii->...i', P) / scale**2
    std: FloatArray = np.sqrt(np.stack([
        variance[..., :2].sum(axis=-1), variance[..., 3:5].sum(axis=-1),
        variance[..., 6:].sum(axis=-1)], axis=-1))
    return std


def detection_probabilities(positions: FloatArray, R_sw: FloatArray, target: PlannedTarget,
                            sampling: Sampling, points: FloatArray, false_alarm: float,
                            background_std: float = 0.0) -> FloatArray:
    """Detection probability (n, 7) in one frame at each point (n, 2), for each moment direction.

    `background_std` [T] of the background errors is added to the noise. T10 eq. (5.14)-(5.19).
    """
    single_frame = Sampling(sampling.period, sampling.noise_std, half_window=0.0)
    energy_ratio = np.empty((len(points), len(DIRECTIONS)))
    for part, h, _ in pass_fields(positions, R_sw, target, single_frame, points, 0.0):
        squared_norm = np.einsum('pdksa,pdksa->pds', h, h)
        energy_ratio[part] = (squared_norm / (
            np.square(sampling.noise_std) + background_std**2)).sum(axis=-1)
    axes = 3 * len(positions)
    return detection_probability(energy_ratio, energy_threshold(false_alarm, axes), axes)
