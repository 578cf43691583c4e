"""Another explanation of the latest frames of a track: with other vehicles, or one more."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.reach import DETECTABLE_ENERGY, field_energies
from mag_tracking.stages.track.relinearisation import Window

SURE_NATS = 15.0
"""[nats] An explanation that is believed by less than this is doubted for a while: evidence counts
what a model leaves out of the field as if it were independent in each frame, and says too much."""

IMPLAUSIBLE_NATS = 60.0
"""[nats] As `SURE_NATS`, where two vehicles cross, or one overtakes the other at more than
`OVERTAKING_RATIO`: traffic does so less often than a flipped axis or a train looks like it."""

CROSSING_COSINE = 0.9
"""Two vehicles cross where the cosine of the angle between their velocities is smaller in size."""

OVERTAKING_RATIO = 1.8
"""Largest usual ratio of the speeds of two vehicles that go the same way."""

STANDING = 1.0
"""[m/s] A slower vehicle is not compared with others: its heading is not known."""


@dataclass(frozen=True)
class Joint:
    """Hypotheses of the tracked vehicles and a new one, whose state comes last."""

    bank: FilterBank
    """At the latest frame of the window."""
    window: Window
    """With the hypotheses of all as its anchor."""
    bank_filter: BankFilter
    log_odds: float
    """[nats] Against the track as it is."""
    replaced: int | None
    """The vehicle of the track that was sought anew, and is now the last or one of the last two."""
    adds: bool
    """There is a vehicle more."""

    def doubtful(self, n_one: int) -> tuple[int, ...]:
        """Places of vehicles that may be others, each of `n_one` states.

        One that was found elsewhere; two that took the place of one and go the same way, as a long
        vehicle of which the model leaves much out looks like two; all of a weak explanation, and
        of one by vehicles that cross, or of which one is much faster, `IMPLAUSIBLE_NATS`.
        """
        n = self.bank.label.shape[1] if self.bank.label.ndim > 1 else 1
        x = self.bank.x[self.bank.best()]
        velocity = np.array([x[k * n_one + 3:k * n_one + 5] for k in range(n)])
        is_implausible = self.adds and _are_implausible(velocity, 1 if self.replaced is None else 2)
        if self.log_odds < (IMPLAUSIBLE_NATS if is_implausible else SURE_NATS):
            return tuple(range(n))
        if self.replaced is None:
            return ()
        if not self.adds:
            return (n - 1,)
        return (n - 2, n - 1) if velocity[-2] @ velocity[-1] > 0.0 else ()


def _are_implausible(velocity: FloatArray, n_new: int) -> bool:
    """Whether one of the last `n_new` vehicles crosses another's way, or goes the same way much
    faster or slower; `velocity` (n, 2) [m/s]."""
    speed = np.linalg.norm(velocity, axis=1)
    for i in range(len(velocity) - n_new, len(velocity)):
        for k in range(i):
            slower, faster = sorted((speed[i], speed[k]))
            cosine = velocity[i] @ velocity[k] / max(slower * faster, STANDING**2)
            if slower >= STANDING and (abs(cosine) < CROSSING_COSINE or
                                       cosine > 0.0 and faster > OVERTAKING_RATIO * slower):
                return True
    return False


def are_felt_by_two(joint: Joint) -> bool:
    """Whether two sensors feel each of the vehicles that were sought: what one alone feels may be a
    fault of that sensor."""
    n, best = joint.bank.label.shape[1], joint.bank.best()
    for i in range(n - (1 if joint.replaced is None else 2), n):
        energy = sum(field_energies(joint.bank_filter, i, path[best], frame) for path, frame in
                     zip(joint.window.paths, joint.window.frames, strict=True))
        if np.count_nonzero(energy > DETECTABLE_ENERGY) < 2:
            return False
    return True
