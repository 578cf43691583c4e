"""Track histories for reports: poses, weights and fields of each track."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.records import FieldFrame, SmoothedPose, Track, best_of_arrivals

Arrival: TypeAlias = tuple[float, FloatArray, FloatArray]
"""Weight of an arrival direction; position (3,) and covariance (2, 2) of its best hypothesis."""


POSE = 'stamp_ns', 'position', 'velocity', 'covariance', 'moment', 'orientation'
"""Attributes that `Track` and `SmoothedPose` have in common."""


@dataclass
class PoseLog:
    """History of one track; lists have one element per pose."""

    id: int
    stamp_ns: list[int] = field(default_factory=list)
    position: list[FloatArray] = field(default_factory=list)
    velocity: list[FloatArray] = field(default_factory=list)
    covariance: list[FloatArray] = field(default_factory=list)
    moment: list[FloatArray] = field(default_factory=list)
    orientation: list[FloatArray] = field(default_factory=list)


class SmoothedLog(PoseLog):
    """History of one smoothed track."""

    def add(self, pose: SmoothedPose) -> None:
        """Add a smoothed pose."""
        for name in POSE:
            getattr(self, name).append(getattr(pose, name))

    def summary(self) -> dict[str, float]:
        """Horizontal speed, moment and std of the position, where the position is most certain."""
        best = int(np.argmin([np.trace(C[:2, :2]) for C in self.covariance]))
        return {'speed': float(np.hypot(*self.velocity[best][:2])),
                'moment_size': float(np.linalg.norm(self.moment[best])),
                'smallest_sd': float(np.sqrt(np.trace(self.covariance[best][:2, :2])))}


@dataclass
class TrackLog(PoseLog):
    """History of one track; lists have one value per pose, of the `Track` or of its frame."""

    nis: list[float] = field(default_factory=list)
    nis_by_sensor: list[FloatArray] = field(default_factory=list)
    degrees_of_freedom: list[int] = field(default_factory=list)
    ambiguous: list[bool] = field(default_factory=list)
    arrivals: list[dict[str, Arrival]] = field(default_factory=list)
    """Weight and best hypothesis by arrival direction."""
    doubts: list[tuple[str, ...]] = field(default_factory=list)
    kind: list[str] = field(default_factory=list)
    kind_weight: list[float] = field(default_factory=list)
    length: list[float] = field(default_factory=list)
    measured: list[FloatArray] = field(default_factory=list)
    noise: list[FloatArray] = field(default_factory=list)
    """Noise covariances of the frame, (n_sensors, 3, 3) T²."""
    predicted: list[FloatArray] = field(default_factory=list)
    mounting: list[FloatArray] = field(default_factory=list)
    mounting_std: list[FloatArray] = field(default_factory=list)
    existence: float = 0.0
    ended: bool = False

    def add(self, track: Track, frame: FieldFrame) -> None:
        """Add a pose and the frame that produced it, or mark the track as ended."""
        if track.ended:
            self.ended = True
            return
        for name in (*POSE, 'nis', 'nis_by_sensor', 'degrees_of_freedom', 'ambiguous', 'doubts',
                     'predicted', 'mounting', 'mounting_std', 'kind', 'kind_weight', 'length'):
            getattr(self, name).append(getattr(track, name))
        self.measured.append(frame.field)
        self.noise.append(frame.covariance)
        self.existence = track.existence
        self.arrivals.append({h.arrival: (h.weight, h.position, h.covariance[:2, :2])
                              for h in best_of_arrivals(track.hypotheses)})

    def forget(self, n: int) -> None:
        """Remove the `n` oldest poses."""
        for values in vars(self).values():
            if isinstance(values, list):
                del values[:n]

    def seconds(self) -> FloatArray:
        """Time (n,) [s] of each pose since the first pose."""
        stamps = np.array(self.stamp_ns, dtype=np.int64)
        seconds: FloatArray = (stamps - stamps[0]) / 1e9
        return seconds

    def most_certain(self) -> int:
        """Index of the most certain pose, which represents the whole track in summaries.

        The criterion is the variance of the horizontal position for a magnet, and of the horizontal
        velocity for a vehicle. The position of a vehicle may become more certain only later, after
        its whole length has passed.
        """
        first = 3 if self.kind[-1] else 0
        return int(np.argmin([np.trace(C[first:first + 2, first:first + 2])
                              for C in self.covariance]))

    def mounting_of(self, names: Sequence[str]) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Mounting errors (3,) [deg] and their stds by sensor, at the most certain pose.

        Empty if mounting errors are not estimated.
        """
        k = self.most_certain()
        return {name: (np.degrees(a), np.degrees(sd)) for name, a, sd in
                zip(names, self.mounting[k], self.mounting_std[k], strict=False)}

    def nis_of(self, names: Sequence[str]) -> dict[str, float | None]:
        """Mean normalised innovation squared per axis of each sensor; None without readings.

        The value is about 1 or less if a sensor agrees with the model and with the other sensors.
        """
        axes = (~np.isnan(np.array(self.measured))).sum(axis=(0, 2))
        total = np.nansum(np.array(self.nis_by_sensor), axis=0)
        return {name: float(q / n) if n else None
                for name, q, n in zip(names, total, axes, strict=True)}

    def summary(self) -> dict[str, Any]:
        """Summarise the track in values that JSON can represent.

        Speed and moment are taken from the `most_certain` pose, arrival and kind from the last
        pose. The verdict is `unique` if neither pose is ambiguous.
        """
        best = self.most_certain()
        final = self.arrivals[-1]
        arrival = max(final, key=lambda name: final[name][0])
        nis = np.array(self.nis) / np.maximum(1, self.degrees_of_freedom)
        is_measured = np.isfinite(nis)
        return {
            'id': self.id, 'start_ns': self.stamp_ns[0], 'end_ns': self.stamp_ns[-1],
            'poses': len(self.stamp_ns), 'ended': self.ended, 'arrival': arrival,
            'arrival_weights': {k: v[0] for k, v in sorted(final.items())},
            'kind': self.kind[-1], 'kind_weight': self.kind_weight[-1],
            'length': self.length[best],
            'verdict': 'ambiguous' if self.ambiguous[-1] or self.ambiguous[best] else 'unique',
            'ambiguous_share': float(np.mean(self.ambiguous)),
            'doubts': dict(Counter(name for names in self.doubts for name in names)),
            'existence': self.existence,
            'speed': float(np.linalg.norm(self.velocity[best][:2])),
            'heading_deg': float(np.degrees(np.arctan2(self.velocity[best][1],
                                                       self.velocity[best][0]))),
            'moment': [float(v) for v in self.moment[best]],
            'moment_size': float(np.linalg.norm(self.moment[best])),
            'smallest_sd': float(np.sqrt(min(np.trace(C[:2, :2]) for C in self.covariance))),
            'nis_per_axis': float(nis[is_measured].mean()) if is_measured.any() else None,
        }
