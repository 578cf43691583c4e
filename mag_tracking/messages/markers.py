"""RViz markers of tracks (90 % ellipsoid, moment arrow, label) and sensors.

Each kind of marker has its own namespace, which a viewer can hide. Each track has its own marker
id. Markers of a track expire if they are not deleted.
"""

from typing import Any

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import quaternion_from_rotation
from mag_tracking.messages.schema import header_dict, xyz
from mag_tracking.network import SensorNetwork
from mag_tracking.records import PoseUncertainty, Track

TRACK_NAMESPACES = ('ellipsoid', 'moment', 'label')
"""Marker namespaces of a track."""
SENSOR_NAMESPACES = ('sensors', 'sensor_labels')
"""Marker namespaces of a sensor."""
LIFETIME_S = 2
"""[s] Lifetime of the markers of a track."""
_ARROW, _CUBE, _SPHERE, _TEXT = 0, 1, 2, 9
_ADD, _DELETE = 0, 2
_REGION_RADIUS = 2.5003
"""Radius of the 90 % region in standard deviations (chi-square, 3 degrees of freedom)."""
SENSOR_SIZE_M = 0.3
"""[m] Maximum length of a sensor marker; the length is at most half the smallest sensor
distance."""
_UPRIGHT = {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0}
_BLUE, _RED = {'r': 0.0, 'g': 0.45, 'b': 0.7}, {'r': 0.84, 'g': 0.37, 'b': 0.0}
"""Colours that remain distinguishable with colour blindness (Okabe and Ito)."""
_GREY = {'r': 0.35, 'g': 0.35, 'b': 0.35, 'a': 1.0}


def track_markers(track: Track, frame: str) -> dict[str, Any]:
    """Markers of a `Track`: ellipsoid, moment arrow and label, as a visualization_msgs/MarkerArray.

    The ellipsoid shows the covariance of the pose topics, which covers all hypotheses of an
    ambiguous track.
    """
    return {'markers': [_ellipsoid(track, frame), _arrow(track, frame), _label(track, frame)]}


def delete_markers(track: Track, frame: str) -> dict[str, Any]:
    """MarkerArray that deletes the displayed markers of an ended `Track`."""
    return {'markers': [_marker(track, frame, namespace, _SPHERE, action=_DELETE)
                        for namespace in TRACK_NAMESPACES]}


def sensor_markers(network: SensorNetwork) -> dict[str, Any]:
    """MarkerArray that shows the sensors and their names."""
    size = min(SENSOR_SIZE_M, 0.5 * _smallest_distance(network.positions))
    markers = []
    for j, name in enumerate(network.names):
        common = {'header': header_dict(0, network.frame), 'id': j, 'action': _ADD}
        markers.append({
            **common, 'ns': SENSOR_NAMESPACES[0], 'type': _CUBE, 'color': _GREY,
            'pose': {'position': xyz(network.positions[j]), 'orientation': _quaternion(
                network.R_ws[j])}, 'scale': xyz(np.array([1.0, 0.6, 0.2]) * size)})
        above = network.positions[j] + [0.0, 0.0, size]
        markers.append({
            **common, 'ns': SENSOR_NAMESPACES[1], 'type': _TEXT, 'color': _GREY, 'text': name,
            'pose': {'position': xyz(above), 'orientation': _UPRIGHT},
            'scale': {'x': 0.0, 'y': 0.0, 'z': size}})
    return {'markers': markers}


def _smallest_distance(positions: FloatArray) -> float:
    """Smallest distance [m] between two sensors; infinite for a single sensor."""
    distances = np.linalg.norm(positions[:, None] - positions, axis=-1)
    np.fill_diagonal(distances, np.inf)
    return float(distances.min())


def _marker(track: Track, frame: str, namespace: str, shape: int,
            **message_fields: Any) -> dict[str, Any]:
    """Build a visualization_msgs/Marker as a dict."""
    return {'header': header_dict(track.stamp_ns, frame), 'ns': namespace, 'id': track.id,
            'type': shape, **message_fields}


def _quaternion(R: FloatArray) -> dict[str, float]:
    """Convert a rotation matrix to a geometry_msgs/Quaternion as a dict."""
    return dict(zip('xyzw', quaternion_from_rotation(R).tolist(), strict=True))


def _ellipsoid(track: Track, frame: str) -> dict[str, Any]:
    """Ellipsoid marker of the 90 % region of the position."""
    uncertainty: Track | PoseUncertainty = track.topic_uncertainty or track
    variances, R = np.linalg.eigh(uncertainty.covariance[:3, :3])
    if np.linalg.det(R) < 0.0:
        R = -R
    diameters = 2.0 * _REGION_RADIUS * np.sqrt(np.maximum(variances, 0.0))
    return _marker(
        track, frame, 'ellipsoid', _SPHERE, action=_ADD, lifetime={'sec': LIFETIME_S},
        pose={'position': xyz(track.position), 'orientation': _quaternion(R)},
        # RViz rejects spheres with zero thickness.
        scale=xyz(np.maximum(diameters, 1e-6)),
        color={**_BLUE, 'a': 0.15 if track.ambiguous else 0.35})


def _arrow(track: Track, frame: str) -> dict[str, Any]:
    """Arrow marker along the moment; its length is three times the RMS error of the position."""
    length = max(float(np.sqrt(np.trace(track.covariance[:3, :3]))), 1e-3) * 3.0
    tip = track.position + length * track.moment / np.linalg.norm(track.moment)
    return _marker(
        track, frame, 'moment', _ARROW, action=_ADD, lifetime={'sec': LIFETIME_S},
        points=[xyz(track.position), xyz(tip)], pose={'orientation': _UPRIGHT},
        scale={'x': 0.08 * length, 'y': 0.16 * length, 'z': 0.2 * length},
        color={**_RED, 'a': 1.0})


def _label(track: Track, frame: str) -> dict[str, Any]:
    """Text marker with track id, kind and speed, and a question mark if the track is ambiguous."""
    size = float(np.clip(np.sqrt(np.trace(track.covariance[:3, :3])), 0.005, 0.5))
    words = [word for word in (f'{track.id}', track.kind,
                               f'{np.hypot(*track.velocity[:2]):.1f} m/s') if word]
    return _marker(
        track, frame, 'label', _TEXT, action=_ADD, lifetime={'sec': LIFETIME_S},
        text=' '.join(words) + ('?' if track.ambiguous else ''),
        pose={'position': xyz(track.position + [0.0, 0.0, 2.0 * size]), 'orientation': _UPRIGHT},
        scale={'x': 0.0, 'y': 0.0, 'z': size}, color={**_GREY})
