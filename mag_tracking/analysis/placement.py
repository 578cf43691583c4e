"""What a network of sensors can know of a target that passes: bounds and detection, for planning.

A point target on a straight line at constant speed, with the states [r, v, m]; the moment's
direction is not known beforehand, so everything is taken over `DIRECTIONS`. The bounds are those of
TSP14 section IV and MITRE12 section 4, with the backgrounds unknown as well.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.detection_theory import detection_probability, energy_threshold
from mag_tracking.physics.dipole import sensor_fields

DIRECTIONS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], *(
    np.array(d) / np.sqrt(3.0) for d in ((1, 1, 1), (1, 1, -1), (1, -1, 1), (-1, 1, 1)))])
"""(7, 3) of the moment; the opposite ones give the same information."""

STATES = ('x', 'y', 'z', 'vx', 'vy', 'vz', 'mx', 'my', 'mz')

MAX_AT_ONCE = 200_000
"""Fields computed at once; more are done in turn, so that memory stays small."""


@dataclass(frozen=True)
class PlannedTarget:
    """What is expected to pass."""

    moment: float
    """[A m^2] its size."""
    height: float
    """[m] of its magnetic centre."""
    speed: float
    """[m/s]."""
    height_std: float = np.inf
    """[m] how well the height is known beforehand; inf = not at all."""
    climb_std: float = np.inf
    """[m/s] the same of the vertical speed."""
    moment_known: bool = True
    """Whether the moment's size is known beforehand, to the size itself; never its direction."""

    def prior(self) -> FloatArray:
        """(9, 9) information of what is known beforehand; MITRE12 eq. (28)."""
        std = np.full(9, np.inf)
        std[2], std[5] = self.height_std, self.climb_std
        if self.moment_known:
            std[6:] = self.moment / np.sqrt(3.0)
        return np.diag(1.0 / std**2)


@dataclass(frozen=True)
class Sampling:
    """How the sensors look at it."""

    period: float
    """[s] between frames."""
    noise_std: FloatArray | float
    """(n_sensors,) [T] of one axis of one frame, or one for all."""
    field_error: float = 0.0
    """Relative error of the field, by clocks, mountings and the model, as noise frame by frame; of
    an error that lasts, the root of the number of frames that it lasts times as much."""
    background_std: float = np.inf
    """[T] how well the backgrounds are known; inf = not at all."""
    half_window: float = 3.0
    """[s] the target is followed so long before and after the point that is asked about."""
    max_frames: int = 60

    def times(self) -> tuple[FloatArray, float]:
        """(k,) [s] of the frames, and how many real ones each stands for."""
        n = 2 * int(self.half_window / self.period) + 1
        k = min(n, self.max_frames // 2 * 2 + 1)
        t = np.linspace(-self.half_window, self.half_window, k, dtype=np.float64)
        return t, n / k


def pass_fields(positions: FloatArray, R_sw: FloatArray, target: PlannedTarget,
                sampling: Sampling, points: FloatArray,
                heading: float) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
    """Fields and Jacobians of passes through points, for every direction of the moment.

    Parameters
    ----------
    positions, R_sw : (n_sensors, 3), (n_sensors, 3, 3)
    target : PlannedTarget
    sampling : Sampling
    points : (n, 2) [m], world
    heading : float [rad]

    Yields (slice of points, h (n_p, 7, k, n_sensors, 3) [T], H (n_p, 7, k, n_sensors, 3, 9)), a
    part of the points at a time.
    """
    t, _ = sampling.times()
    v = target.speed * np.array([np.cos(heading), np.sin(heading), 0.0])
    shape = len(DIRECTIONS), len(t)
    size = shape[0] * shape[1]
    # [r, v, m] at the point; the target is at r + t v.
    dr_dx, dm_dx = np.zeros((2, *shape, 3, 9))
    dr_dx[..., range(3), range(3)] = 1.0
    dr_dx[..., range(3), range(3, 6)] = t[:, None]
    dm_dx[..., range(3), range(6, 9)] = 1.0
    m = np.broadcast_to(target.moment * DIRECTIONS[:, None], (*shape, 3))
    step = max(1, MAX_AT_ONCE // (size * len(positions)))
    for first in range(0, len(points), step):
        some = points[first:first + step]
        n = len(some)
        r0 = np.column_stack([some, np.full(n, target.height)])
        r = np.broadcast_to(r0[:, None, None] + t[:, None] * v, (n, *shape, 3))

        def repeated(a: FloatArray, n: int = n) -> FloatArray:
            """The same for each of the points."""
            return np.tile(a.reshape(size, 1, *a.shape[2:]), (n, *[1] * (a.ndim - 1)))

        h, H, _ = sensor_fields(positions, R_sw, r.reshape(n * size, 1, 3).copy(), repeated(m),
                                repeated(dr_dx), repeated(dm_dx))
        # On the very sensor there is no field; that look tells nothing.
        on_it = ~(np.isfinite(h).all(axis=-1) & np.isfinite(H).all(axis=(-2, -1)))
        h[on_it], H[on_it] = 0.0, 0.0
        yield (slice(first, first + n), h.reshape(n, *shape, -1, 3),
               H.reshape(n, *shape, len(positions), 3, 9))


def pass_information(positions: FloatArray, R_sw: FloatArray, target: PlannedTarget,
                     sampling: Sampling, points: FloatArray, heading: float) -> FloatArray:
    """Fisher information of each sensor about [r, v, m] at the moment the target is at a point.

    The backgrounds are eliminated: what is constant over the pass says nothing beyond their prior.

    Returns (n, 7, n_sensors, 9, 9). Parameters as for `pass_fields`.
    Source: TSP14 eq. (28), (40); MITRE12 eq. (17), (30).
    """
    _, each = sampling.times()
    out = np.empty((len(points), len(DIRECTIONS), len(positions), 9, 9))
    for part, h, H in pass_fields(positions, R_sw, target, sampling, points, heading):
        variance = (np.square(sampling.noise_std) + sampling.field_error**2 * np.einsum(
            'pdksa,pdksa->pdks', h, h)) / each
        weighted = H / variance[..., None, None]
        J = np.einsum('pdksai,pdksaj->pdsij', weighted, H, optimize=True)
        mean = weighted.sum(axis=2)
        total = (1.0 / variance).sum(axis=2) + 1.0 / sampling.background_std**2
        out[part] = J - np.einsum('pdsai,pdsaj->pdsij', mean, mean) / total[..., None, None]
    return out


def bounds_of(information: FloatArray, prior: FloatArray) -> FloatArray:
    """Standard deviations that no unbiased estimate beats, per block.

    Parameters
    ----------
    information : (..., 9, 9)
        About [r, v, m].
    prior : (9, 9)

    Returns (..., 3): of position and velocity in the plane, root of the summed variances [m],
    [m/s]; of the moment [A m^2]. What hardly is observable is large, and at most 1e6 of its unit.
    Source: TSP14 eq. (42)-(45), the trace in place of the norm; MITRE12 eq. (32).
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
                            allowance: float = 0.0) -> FloatArray:
    """Probability that one frame exceeds the detection's threshold with the target at a point.

    Parameters
    ----------
    positions, R_sw, target, sampling, points
        As for `pass_fields`.
    false_alarm : float
        Probability of a frame of noise alone.
    allowance : float [T]
        What the backgrounds may be off by, added to the noise.

    Returns (n, 7), for every direction of the moment. Source: T10 eq. (5.14)-(5.19), over all
    sensors at once.
    """
    still = Sampling(sampling.period, sampling.noise_std, half_window=0.0)
    ratio = np.empty((len(points), len(DIRECTIONS)))
    for part, h, _ in pass_fields(positions, R_sw, target, still, points, 0.0):
        size2 = np.einsum('pdksa,pdksa->pds', h, h)
        ratio[part] = (size2 / (np.square(sampling.noise_std) + allowance**2)).sum(axis=-1)
    axes = 3 * len(positions)
    return detection_probability(ratio, energy_threshold(false_alarm, axes), axes)
