"""What RViz shows of a track: the 90 % ellipsoid and an arrow along the moment."""

from typing import Any

import numpy as np

from mag_tracking.geometry import quaternion_from_rotation
from mag_tracking.messages.schema import header_dict
from mag_tracking.records import Track

_ELLIPSOID, _MOMENT = 0, 1
_SPHERE, _ARROW = 2, 0
_ADD, _DELETE = 0, 2
_SCALE_3D = 2.5003
"""Deviations to the surface of the 90 % region in space (chi-square, 3 degrees of freedom)."""


def _marker(track: Track, frame: str, kind: int, shape: int, **content: Any) -> dict[str, Any]:
    """A visualization_msgs/Marker as a dict; each track has its own name space."""
    return {'header': header_dict(track.stamp_ns, frame), 'ns': f'track_{track.id}', 'id': kind,
            'type': shape, **content}


def track_markers(track: Track, frame: str) -> dict[str, Any]:
    """visualization_msgs/MarkerArray of a `Track`, as a dict."""
    values, R = np.linalg.eigh(track.covariance[:3, :3])
    if np.linalg.det(R) < 0.0:
        R = -R
    axes = 2.0 * _SCALE_3D * np.sqrt(np.maximum(values, 0.0))
    position = dict(zip('xyz', track.position.tolist(), strict=True))
    ellipsoid = _marker(
        track, frame, _ELLIPSOID, _SPHERE, action=_ADD,
        pose={'position': position, 'orientation': dict(
            zip('xyzw', quaternion_from_rotation(R).tolist(), strict=True))},
        # A sphere of no thickness is refused by RViz.
        scale=dict(zip('xyz', np.maximum(axes, 1e-6).tolist(), strict=True)),
        color={'r': 0.2, 'g': 0.5, 'b': 1.0, 'a': 0.15 if track.ambiguous else 0.35})
    length = max(float(np.sqrt(np.trace(track.covariance[:3, :3]))), 1e-3) * 3.0
    tip = track.position + length * track.moment / np.linalg.norm(track.moment)
    arrow = _marker(
        track, frame, _MOMENT, _ARROW, action=_ADD,
        points=[position, dict(zip('xyz', tip.tolist(), strict=True))],
        pose={'orientation': {'w': 1.0}},
        scale={'x': 0.08 * length, 'y': 0.16 * length, 'z': 0.2 * length},
        color={'r': 0.9, 'g': 0.2, 'b': 0.1, 'a': 1.0})
    return {'markers': [ellipsoid, arrow]}


def delete_markers(track: Track, frame: str) -> dict[str, Any]:
    """Takes the markers of an ended `Track` away."""
    return {'markers': [_marker(track, frame, kind, shape, action=_DELETE)
                        for kind, shape in ((_ELLIPSOID, _SPHERE), (_MOMENT, _ARROW))]}
