"""A second opinion on a running track, once its vehicle has passed: see `rigid_pass`."""

from collections import deque
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.clock_evidence import ClockEvidence
from mag_tracking.stages.track.plausibility import moves_too_far
from mag_tracking.stages.track.rigid_pass import LEAST_WAY, RigidPass, fit_rigid_pass
from mag_tracking.units import NS

PASSED = 0.6
"""A vehicle has passed once the field is below this share of its largest."""

FIRST_S = 0.12
"""[s] After the strongest field: the first opinion."""

AGAIN = 1.7
"""The next one follows after so many times as long: each has more to go by."""

LEAST_FRAMES, MOST_FRAMES = 12, 128
"""The latest frames are looked at, if there are as many."""

MOST_FITTED = 64
"""Of more frames, every other one."""


MISFIT = 1.5
"""A pass is of no vehicle on a steady path where the reduced chi-square is larger: the one of cars
and trucks past good sensors is 0.5 to 1.2."""

STEADY_S = 1.5
"""[s] After the strongest field: until then a vehicle goes on as steadily as it passed."""

MISFIT_LATER = 8.0
"""What it may then do makes it as large as 5, not larger."""


class _Seen(NamedTuple):
    """A frame of the track."""

    frame: FieldFrame
    size: float
    """[T] largest field of a sensor."""
    state: FloatArray
    """(6,) position and velocity as they were then published."""


class SecondOpinion:
    """The latest frames of a track, and what a rigid path says of them.

    Attributes
    ----------
    latest : RigidPass or None
        None before the vehicle has passed.
    """

    def __init__(self, network: SensorNetwork) -> None:
        self.latest: RigidPass | None = None
        self._network = network
        self._frames: deque[_Seen] = deque(maxlen=MOST_FRAMES)
        # When the field was strongest, and how long after it the next opinion is due.
        self._peak_ns, self._due_s = -1, FIRST_S
        self._is_misfit = False

    def add(self, frame: FieldFrame, state: FloatArray) -> None:
        """Take a frame, and the `state` (n_x,) of the best hypothesis."""
        size = float(np.sqrt(np.nansum(np.square(frame.field), axis=1).max(initial=0.0)))
        self._frames.append(_Seen(frame, size, state[:6].copy()))

    def doubts(self, clocks_apart_s: float) -> set[str]:
        """Doubts about the track by now; earlier ones say that the clocks are so far apart [s]."""
        if not self._frames:
            return set()
        self._form_if_due(self._frames[-1].size)
        found = self._of_pass()
        speed = float(np.hypot(*self._frames[-1].state[3:5]))
        if clocks_apart_s * speed > LEAST_WAY:
            found.add(doubts.CLOCKS_APART)
        return found

    @property
    def is_doubtful(self) -> bool:
        """Whether the latest opinion doubts the track."""
        return bool(self._of_pass())

    def conclude(self, clocks: ClockEvidence, rows: IntArray) -> None:
        """The track ends: form a last opinion, and tell the `clocks` of the sensors `rows`."""
        if self._frames:
            self._form_if_due(0.0)
        if self.latest is not None:
            clocks.add(self.latest, rows)

    def _form_if_due(self, size: float) -> None:
        """Form an opinion if it is time to; the field is now of this `size` [T]."""
        peak = max(self._frames, key=lambda seen: seen.size)
        if peak.frame.stamp_ns != self._peak_ns:
            self._peak_ns, self._due_s = peak.frame.stamp_ns, FIRST_S
        since = (self._frames[-1].frame.stamp_ns - self._peak_ns) / NS
        if since < self._due_s or size > PASSED * peak.size or len(self._frames) < LEAST_FRAMES:
            return
        self._due_s = AGAIN * since
        now = self._frames[-1]
        back = now.state.copy()
        # Searched for from what the filter says now, and from what it said then.
        back[:3] -= since * back[3:]
        frames = [seen.frame for seen in self._frames]
        self.latest = fit_rigid_pass(self._network, frames[::-(-len(frames) // MOST_FITTED)],
                                     self._peak_ns, np.array([back, peak.state]))
        if self.latest is not None and since <= STEADY_S:
            self._is_misfit = self.latest.misfit > MISFIT

    def _of_pass(self) -> set[str]:
        """Doubts by the latest opinion."""
        found: set[str] = set()
        latest = self.latest
        if latest is None:
            return found
        if self._is_misfit or latest.misfit > MISFIT_LATER:
            found.add(doubts.NO_STEADY_PATH)
        if not latest.is_explained:
            return found
        if latest.needs_clocks_apart:
            found.add(doubts.CLOCKS_APART)
        period = float(np.median(np.diff([seen.frame.stamp_ns for seen in self._frames]))) / NS
        if moves_too_far(latest.closest(self._network.positions), latest.velocity, period,
                         self._network.positions):
            found.add(doubts.FRAMES_TOO_LONG)
        return found
