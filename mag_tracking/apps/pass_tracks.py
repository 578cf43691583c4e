"""Number and approximate paths of the targets that were tracked during a pass."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mag_tracking.analysis.joint_fit import GroundPrior, are_separate
from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import propagated_path
from mag_tracking.records import Track
from mag_tracking.stages.track.initiation_vehicle import CLIMB_STD
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.units import NS


@dataclass(frozen=True)
class _Pose:
    """Position and velocity of a track at one time."""

    stamp_ns: int
    path: FloatArray
    """(6,) position [m] and velocity [m/s], world frame."""
    variance: float
    """Trace of the covariance of the position [m²]."""


class PassTracks:
    """Determines the targets in each pass from the records of a tracker."""

    def __init__(self, settings: TrackSettings) -> None:
        self._is_for_vehicles = settings.target == 'vehicle'
        # {track id: pose of smallest variance in earlier passes, followed by all later poses}.
        self._poses: dict[int, list[_Pose]] = {}
        self._ended: set[int] = set()
        self._last_stamp_ns = 0

    def add(self, records: Iterable[object]) -> None:
        """Store the poses and the ends of tracks from the outputs of a tracker."""
        for record in records:
            if isinstance(record, Track) and record.stamp_ns < self._last_stamp_ns:
                # The time jumped back: earlier poses belong to another pass.
                self._poses.clear()
                self._ended.clear()
            if isinstance(record, Track):
                self._last_stamp_ns = record.stamp_ns
            if isinstance(record, Track) and record.ended:
                self._ended.add(record.id)
            elif isinstance(record, Track):
                self._poses.setdefault(record.id, []).append(_Pose(
                    record.stamp_ns, np.concatenate([record.position, record.velocity]),
                    float(np.trace(record.covariance[:3, :3]))))

    def paths(self, data: PassData) -> FloatArray:
        """Position and velocity (K, 6) [m, m/s, world frame] of each vehicle in a pass when
        `data.t` is zero.

        A vehicle belongs to the pass that contains its pose of smallest variance. Overlapping
        tracks belong to one vehicle that was lost and found again; the track with the smallest
        variance is used. Passes must come in chronological order. There are no paths for magnets.
        """
        end_ns = data.stamp_ns + int(NS * data.t.max())
        candidates = sorted((pose for pose in self._poses_of_smallest_variance(end_ns)
                             if pose.stamp_ns >= data.stamp_ns), key=lambda pose: pose.variance)
        paths: list[FloatArray] = []
        for pose in candidates:
            path = propagated_path(pose.path, (data.stamp_ns - pose.stamp_ns) / NS)
            if self._is_for_vehicles and all(are_separate(data, (path, other)) for other in paths):
                paths.append(path)
        return np.array(paths).reshape(-1, 6)

    def _poses_of_smallest_variance(self, end_ns: int) -> list[_Pose]:
        """Take the pose with the smallest variance up to `end_ns` [ns] of each track; drop the
        others.

        Vehicles that are still approaching are omitted: their latest pose has the smallest
        variance.
        """
        selected = []
        for track, poses in list(self._poses.items()):
            earlier = [pose for pose in poses if pose.stamp_ns <= end_ns]
            later = poses[len(earlier):]
            best = min(earlier, key=lambda pose: pose.variance, default=None)
            if best is None:
                continue
            has_ended = track in self._ended and not later
            if best is not earlier[-1] or has_ended:
                selected.append(best)
            self._poses[track] = [best, *later]
            if has_ended:
                del self._poses[track]
                self._ended.remove(track)
        return selected


def ground_prior(settings: TrackSettings) -> GroundPrior:
    """Prior of the height and vertical speed of vehicles from tracker settings."""
    height, std = np.array([(k.height, k.height_std) for k in settings.vehicle.kinds]).T
    height_std = float(np.sqrt(height.var() + np.square(std).mean()))
    return GroundPrior((float(height.mean()), height_std), CLIMB_STD)
