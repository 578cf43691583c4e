"""Messages for viewers: transforms, 3D detections, and RViz markers of tracks and sensors.

Each kind of marker has its own namespace, which a viewer can hide. Each track has its own marker
id. Markers of a track expire if they are not deleted.
"""

from typing import Any

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import quaternion_from_rotation
from mag_tracking.messages import schema
from mag_tracking.messages.types import MessageDict
from mag_tracking.network import SensorNetwork
from mag_tracking.records import PoseUncertainty, Track

TRACK_NAMESPACES = ('ellipsoid', 'moment', 'label')
SENSOR_NAMESPACES = ('sensors', 'sensor_labels')
LIFETIME_S = 2
_ARROW, _CUBE, _SPHERE, _TEXT = 0, 1, 2, 9
_ADD, _DELETE = 0, 2
_REGION_RADIUS = 2.5003
"""Radius of the 90 % region in standard deviations (chi-square, 3 degrees of freedom)."""
SENSOR_SIZE_M = 0.3
"""[m] Maximum length of a sensor marker, which is at most half the smallest sensor distance."""
_UPRIGHT = {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0}
_BLUE, _RED = {'r': 0.0, 'g': 0.45, 'b': 0.7}, {'r': 0.84, 'g': 0.37, 'b': 0.0}
"""Colours that remain distinguishable with colour blindness (Okabe and Ito)."""
_GREY = {'r': 0.35, 'g': 0.35, 'b': 0.35, 'a': 1.0}


def track_transform_dict(track: Track, frame: str, child_frame: str) -> MessageDict | None:
    """Convert a `Track` to a tf2_msgs/TFMessage from the world frame to the target; None if
    ambiguous, because a transform has neither a flag nor a covariance."""
    if track.ambiguous:
        return None
    return {'transforms': [{
        'header': schema.header_dict(track.stamp_ns, frame), 'child_frame_id': child_frame,
        'transform': {'translation': schema.xyz(track.position),
                      'rotation': schema.quaternion_dict(track.orientation)}}]}


def sensor_transform_dicts(network: SensorNetwork, stamp_ns: int) -> list[MessageDict]:
    """geometry_msgs/TransformStamped from the world frame to each sensor, named after it."""
    return [{'header': schema.header_dict(stamp_ns, network.frame), 'child_frame_id': name,
             'transform': {'translation': schema.xyz(position), 'rotation': schema.quaternion_dict(
                 quaternion_from_rotation(R))}}
            for name, position, R in zip(network.names, network.positions, network.R_ws,
                                         strict=True)]


def detections_3d_dict(track: Track, frame: str) -> MessageDict:
    """Convert a `Track` to vision_msgs/Detection3DArray, empty if it has ended or is withheld.

    Each result is a kind of target with its probability and the pose of the track. Width and height
    of the bounding box are not observable and are 0.
    """
    header = schema.header_dict(track.stamp_ns, frame)
    if track.ended or track.topic_uncertainty is None:
        return {'header': header, 'detections': []}
    pose = schema.pose_with_covariance_dict(track, track.topic_uncertainty)
    weights: dict[str, float] = {}
    for h in track.hypotheses:
        weights[h.kind] = weights.get(h.kind, 0.0) + h.weight
    results = [{'hypothesis': {'class_id': kind or 'magnet', 'score': float(np.clip(w, 0.0, 1.0))},
                'pose': pose} for kind, w in sorted(weights.items(), key=lambda item: -item[1])]
    return {'header': header, 'detections': [{
        'header': header, 'id': str(track.id), 'results': results,
        'bbox': {'center': pose['pose'], 'size': {'x': float(track.length), 'y': 0.0, 'z': 0.0}}}]}


def track_markers(track: Track, frame: str) -> dict[str, Any]:
    """Markers of a `Track` as a visualization_msgs/MarkerArray; the ellipsoid shows the covariance
    of the pose topics, which covers all hypotheses of an ambiguous track."""
    return {'markers': [_ellipsoid(track, frame), _arrow(track, frame), _label(track, frame)]}


def delete_markers(track: Track, frame: str) -> dict[str, Any]:
    """MarkerArray that deletes the displayed markers of an ended `Track`."""
    return {'markers': [_marker(track, frame, namespace, _SPHERE, action=_DELETE)
                        for namespace in TRACK_NAMESPACES]}


def sensor_markers(network: SensorNetwork) -> dict[str, Any]:
    """MarkerArray that shows the sensors and their names."""
    distances = np.linalg.norm(network.positions[:, None] - network.positions, axis=-1)
    np.fill_diagonal(distances, np.inf)
    size = min(SENSOR_SIZE_M, 0.5 * float(distances.min()))
    markers = []
    for j, name in enumerate(network.names):
        common = {'header': schema.header_dict(0, network.frame), 'id': j, 'action': _ADD}
        markers.append({
            **common, 'ns': SENSOR_NAMESPACES[0], 'type': _CUBE, 'color': _GREY,
            'pose': {'position': schema.xyz(network.positions[j]),
                     'orientation': schema.quaternion_dict(
                         quaternion_from_rotation(network.R_ws[j]))},
            'scale': schema.xyz(np.array([1.0, 0.6, 0.2]) * size)})
        above = network.positions[j] + [0.0, 0.0, size]
        markers.append({
            **common, 'ns': SENSOR_NAMESPACES[1], 'type': _TEXT, 'color': _GREY, 'text': name,
            'pose': {'position': schema.xyz(above), 'orientation': _UPRIGHT},
            'scale': {'x': 0.0, 'y': 0.0, 'z': size}})
    return {'markers': markers}


def _marker(track: Track, frame: str, namespace: str, shape: int,
            **message_fields: Any) -> dict[str, Any]:
    return {'header': schema.header_dict(track.stamp_ns, frame), 'ns': namespace, 'id': track.id,
            'type': shape, **message_fields}


def ellipsoid_axes(C: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Standard deviations (3,) along the axes of a covariance (3, 3), and their quaternion xyzw."""
    variances, R = np.linalg.eigh(C)
    if np.linalg.det(R) < 0.0:
        R = -R
    return np.sqrt(np.maximum(variances, 0.0)), quaternion_from_rotation(R)


def _ellipsoid(track: Track, frame: str) -> dict[str, Any]:
    """Ellipsoid marker of the 90 % region of the position."""
    uncertainty: Track | PoseUncertainty = track.topic_uncertainty or track
    std, q = ellipsoid_axes(uncertainty.covariance[:3, :3])
    return _marker(
        track, frame, 'ellipsoid', _SPHERE, action=_ADD, lifetime={'sec': LIFETIME_S},
        pose={'position': schema.xyz(track.position), 'orientation': schema.quaternion_dict(q)},
        # RViz rejects spheres with zero thickness.
        scale=schema.xyz(np.maximum(2.0 * _REGION_RADIUS * std, 1e-6)),
        color={**_BLUE, 'a': 0.15 if track.ambiguous else 0.35})


def _arrow(track: Track, frame: str) -> dict[str, Any]:
    """Arrow marker along the moment; its length is three times the RMS error of the position."""
    length = max(float(np.sqrt(np.trace(track.covariance[:3, :3]))), 1e-3) * 3.0
    tip = track.position + length * track.moment / np.linalg.norm(track.moment)
    return _marker(
        track, frame, 'moment', _ARROW, action=_ADD, lifetime={'sec': LIFETIME_S},
        points=[schema.xyz(track.position), schema.xyz(tip)], pose={'orientation': _UPRIGHT},
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
        pose={'position': schema.xyz(track.position + [0.0, 0.0, 2.0 * size]),
              'orientation': _UPRIGHT},
        scale={'x': 0.0, 'y': 0.0, 'z': size}, color={**_GREY})
