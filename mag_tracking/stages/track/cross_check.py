"""A second opinion on a running track, once its vehicle has passed: see `rigid_pass`."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.clock_comparison import ClockComparison
from mag_tracking.stages.track.disturbances import size_of
from mag_tracking.stages.track.plausibility import moves_too_far
from mag_tracking.stages.track.rigid_pass import (
    LONG_LENGTH,
    MAX_MISFIT,
    MIN_DISTANCE,
    RigidPass,
    fit_rigid_pass,
)
from mag_tracking.stages.track.smoothing import TrackState
from mag_tracking.units import NS

PASSED = 0.6
"""A vehicle has passed once the field is below this share of its largest."""

FIRST_S = 0.12
"""[s] The first opinion follows so long after the strongest field."""

AGAIN = 1.7
"""The next opinion follows after so many times as long."""

BEFORE_S, AFTER_S = 4.0, 3.0
"""[s] Frames from so long before to so long after the strongest field are of the pass."""

MIN_FRAMES, MAX_FRAMES = 12, 128
"""A pass is fitted to no fewer frames; of more every other one is left out, or more of them."""

STEADY_S = 1.5
"""[s] After the strongest field: until then a vehicle goes on as steadily as it passed."""

MISFIT_LATER = 8.0
"""The limit for later opinions, when a car may have turned otherwise than steadily."""


class _Seen(NamedTuple):
    """A frame of the track, in short."""

    stamp_ns: int
    size: float
    """[T] largest field of a sensor."""
    state: FloatArray
    """(6,) position and velocity as they were then published."""


class CrossCheck:
    """The frames of a track, and the fits of its pass as a whole.

    Attributes
    ----------
    latest : RigidPass or None
        None before the vehicle has passed.
    difference : (6,) array, m and m/s
        As `RigidPass.difference`, of the latest state; after the pass that at its end.
    """

    def __init__(self, network: SensorNetwork) -> None:
        self.latest: RigidPass | None = None
        self._network = network
        self._frames: list[FieldFrame] = []
        self._peak: _Seen | None = None
        self._now: _Seen | None = None
        self._period_s = np.inf
        self._due_s = FIRST_S
        self._is_misfit = False
        self._smallest = np.inf
        self._has_risen, self._is_of_whole = False, False
        self.difference: FloatArray = np.zeros(6)

    def add(self, frame: FieldFrame, state: FloatArray) -> None:
        """Take a frame, and the `state` (n_x,) of the best hypothesis."""
        size = float(size_of(frame).max(initial=0.0))
        if self._now is not None:
            # A gap is no frame period.
            self._period_s = min(self._period_s, (frame.stamp_ns - self._now.stamp_ns) / NS)
        self._now = _Seen(frame.stamp_ns, size, state[:6].copy())
        if self._peak is None or size > self._peak.size:
            self._peak, self._due_s = self._now, FIRST_S
            self._has_risen = self._smallest <= PASSED * size
        self._smallest = min(self._smallest, size)
        # What is no longer of this pass, and will not be of another.
        earliest = frame.stamp_ns - BEFORE_S * NS
        self._frames = [f for f in self._frames if f.stamp_ns >= earliest or self._is_of_pass(f)]
        self._frames.append(frame)

    def _is_of_pass(self, frame: FieldFrame) -> bool:
        """Whether a frame is near the strongest field in time."""
        assert self._peak is not None
        return -BEFORE_S * NS <= frame.stamp_ns - self._peak.stamp_ns <= AFTER_S * NS

    def doubts(self, clocks_apart_s: float) -> set[str]:
        """Doubts about the track by now; earlier ones say that the clocks are so far apart [s]."""
        if self._now is None:
            return set()
        self._form_if_due(self._now.size)
        if self._covers(self._now.stamp_ns):
            self.difference = self._differs(self._now.stamp_ns, self._now.state)
        found = self._pass_doubts()
        speed = float(np.hypot(self._now.state[3], self._now.state[4]))
        if clocks_apart_s * speed > MIN_DISTANCE:
            found.add(doubts.CLOCKS_APART)
        return found

    def differences(self, states: Sequence[TrackState]) -> list[FloatArray]:
        """`difference` of each of the smoothed `states`, oldest first.

        Earlier and later states than those of the pass have the difference of its first and last.
        """
        covered = [k for k, (stamp_ns, _, _) in enumerate(states) if self._covers(stamp_ns)]
        if not covered:
            return [self.difference] * len(states)
        first, last = covered[0], covered[-1]
        inside = [self._differs(stamp_ns, x[:6]) for stamp_ns, x, _ in states[first:last + 1]]
        return [inside[min(max(k, first), last) - first] for k in range(len(states))]

    def _covers(self, stamp_ns: int) -> bool:
        """Whether the latest opinion says where the vehicle was at a time.

        Where a track begins with its strongest field, that is a part of a pass, which many paths
        explain.
        """
        return self.latest is not None and self._is_of_whole \
            and -BEFORE_S * NS <= stamp_ns - self.latest.stamp_ns <= AFTER_S * NS

    def _differs(self, stamp_ns: int, state: FloatArray) -> FloatArray:
        """(6,) difference of a `state` (6,) at a time that the latest opinion covers."""
        assert self.latest is not None
        return self.latest.difference(stamp_ns, state)

    @property
    def is_doubtful(self) -> bool:
        """Whether the latest opinion doubts the track."""
        return bool(self._pass_doubts())

    def conclude(self, clocks: ClockComparison, rows: IntArray) -> None:
        """The track ends: form a last opinion, and tell the `clocks` of the sensors `rows`."""
        self._form_if_due(0.0)
        if self.latest is not None:
            clocks.add(self.latest, rows)

    def _form_if_due(self, size: float) -> None:
        """Form an opinion if it is time to; the field is now of this `size` [T]."""
        now, peak = self._now, self._peak
        if now is None or peak is None or self._due_s > AFTER_S or size > PASSED * peak.size:
            return
        since = (now.stamp_ns - peak.stamp_ns) / NS
        frames = [f for f in self._frames if self._is_of_pass(f)]
        if since < self._due_s or len(frames) < MIN_FRAMES:
            return
        self._due_s = AGAIN * since
        # The search starts from what the filter says now, and from what it said then.
        back = now.state.copy()
        back[:3] -= since * back[3:]
        step = -(-len(frames) // MAX_FRAMES)
        found = fit_rigid_pass(self._network, frames[::step], peak.stamp_ns,
                               np.array([back, peak.state]))
        if found is None:
            return
        self.latest, self._is_of_whole = found, self._has_risen
        if since <= STEADY_S:
            self._is_misfit = found.misfit > MAX_MISFIT

    def _pass_doubts(self) -> set[str]:
        """Doubts by the latest opinion."""
        found: set[str] = set()
        latest = self.latest
        if latest is None:
            return found
        # The middle of a long vehicle is uncertain by as much as it is long, and not by more.
        if np.hypot(self.difference[0], self.difference[1]) > LONG_LENGTH:
            found.add(doubts.ANOTHER_PLACE)
        if self._is_misfit or latest.misfit > MISFIT_LATER:
            found.add(doubts.NO_STEADY_PATH)
        if not latest.is_explained:
            return found
        if latest.needs_clocks_apart:
            found.add(doubts.CLOCKS_APART)
        if moves_too_far(latest.closest(self._network.positions), latest.velocity,
                         self._period_s, self._network.positions):
            found.add(doubts.FRAMES_TOO_LONG)
        return found
