"""Number and approximate paths of the targets that were tracked during a pass."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mag_tracking.analysis.joint_fit import GroundPrior, are_separate
from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import propagated_path
from mag_tracking.records import Track
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.units import NS


@dataclass(frozen=True)
class _Pose:
    """A pose of a track."""

    stamp_ns: int
    path: FloatArray
    """(6,) position and velocity."""
    spread: float
    """[m^2] Trace of the covariance of the position."""


class PassTracks:
    """Takes the records of a tracker, and gives the targets of each pass."""

    def __init__(self, settings: TrackSettings) -> None:
        """`settings` of the tracker."""
        self._of_vehicles = settings.target == 'vehicle'
        # The surest pose of each track in earlier passes, and all later poses.
        self._poses: dict[int, list[_Pose]] = {}
        self._ended: set[int] = set()
        self._latest_ns = 0

    def take(self, records: Iterable[object]) -> None:
        """Note the poses among the records of a tracker."""
        for record in records:
            if isinstance(record, Track) and record.stamp_ns < self._latest_ns:
                # The time jumped back: what was is of another pass.
                self._poses.clear()
                self._ended.clear()
            if isinstance(record, Track):
                self._latest_ns = record.stamp_ns
            if isinstance(record, Track) and record.ended:
                self._ended.add(record.id)
            elif isinstance(record, Track):
                self._poses.setdefault(record.id, []).append(_Pose(
                    record.stamp_ns, np.concatenate([record.position, record.velocity]),
                    float(np.trace(record.covariance[:3, :3]))))

    def paths(self, data: PassData) -> FloatArray:
        """Position and velocity (K, 6) [m], [m/s] of each vehicle when `data.t` is zero.

        A vehicle belongs to the pass if its pose with the smallest covariance does. Of tracks that
        overlap only the most certain one counts: the vehicle was lost and found again. Passes have
        to come in order; magnets have no paths.
        """
        end_ns = data.stamp_ns + int(NS * data.t.max())
        mine = sorted((pose for pose in self._surest_until(end_ns)
                       if pose.stamp_ns >= data.stamp_ns), key=lambda pose: pose.spread)
        paths: list[FloatArray] = []
        for pose in mine:
            path = propagated_path(pose.path, (data.stamp_ns - pose.stamp_ns) / NS)
            if self._of_vehicles and all(are_separate(data, (path, other)) for other in paths):
                paths.append(path)
        return np.array(paths).reshape(-1, 6)

    def _surest_until(self, end_ns: int) -> list[_Pose]:
        """The surest pose of each track until a time, but for vehicles that are still approaching:
        their latest pose is the surest. Older poses are dropped.
        """
        found = []
        for track, poses in list(self._poses.items()):
            until = [pose for pose in poses if pose.stamp_ns <= end_ns]
            later = poses[len(until):]
            surest = min(until, key=lambda pose: pose.spread, default=None)
            if surest is None:
                continue
            has_ended = track in self._ended and not later
            if surest is not until[-1] or has_ended:
                found.append(surest)
            self._poses[track] = [surest, *later]
            if has_ended:
                del self._poses[track]
                self._ended.remove(track)
        return found


def ground_prior(settings: TrackSettings) -> GroundPrior:
    """The prior of height and climb that the settings of a tracker describe."""
    vehicle = settings.vehicle
    height, std = np.array(vehicle.heights), np.array(vehicle.height_stds)
    spread = float(np.sqrt(height.var() + np.square(std).mean()))
    return GroundPrior((float(height.mean()), spread), vehicle.climb_std)
