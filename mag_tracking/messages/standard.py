"""Conversion of tracks and sensors to standard ROS messages: transforms and 3D detections."""

import numpy as np

from mag_tracking.geometry import quaternion_from_rotation
from mag_tracking.messages.schema import header_dict, pose_with_covariance_dict, xyz
from mag_tracking.messages.shapes import MessageDict
from mag_tracking.network import SensorNetwork
from mag_tracking.records import Track


def track_transform_dict(track: Track, frame: str, child_frame: str) -> MessageDict | None:
    """Convert a `Track` to a tf2_msgs/TFMessage from the world frame to the target.

    None if the pose is ambiguous, because a transform has neither a flag nor a covariance.
    """
    if track.ambiguous:
        return None
    return {'transforms': [{
        'header': header_dict(track.stamp_ns, frame), 'child_frame_id': child_frame,
        'transform': {'translation': xyz(track.position), 'rotation': {
            **xyz(track.orientation), 'w': float(track.orientation[3])}}}]}


def sensor_transform_dicts(network: SensorNetwork, stamp_ns: int) -> list[MessageDict]:
    """geometry_msgs/TransformStamped from the world frame to each sensor, named after it."""
    quaternions = map(quaternion_from_rotation, network.R_ws)
    return [{'header': header_dict(stamp_ns, network.frame),
             'child_frame_id': name,
             'transform': {'translation': xyz(position), 'rotation': {
                 **xyz(q), 'w': float(q[3])}}}
            for name, position, q in zip(network.names, network.positions, quaternions,
                                         strict=True)]


def detections_3d_dict(track: Track, frame: str) -> MessageDict:
    """Convert a `Track` to vision_msgs/Detection3DArray, empty if it has ended or is withheld.

    Each result of a detection is a kind of target with its probability and the pose of the track.
    The bounding box has the length of the line of dipoles; its width and height are not observable
    and are 0.
    """
    header = header_dict(track.stamp_ns, frame)
    if track.ended or track.topic_uncertainty is None:
        return {'header': header, 'detections': []}
    pose = pose_with_covariance_dict(track, track.topic_uncertainty)
    weights: dict[str, float] = {}
    for h in track.hypotheses:
        weights[h.kind] = weights.get(h.kind, 0.0) + h.weight
    results = [{'hypothesis': {'class_id': kind or 'magnet', 'score': float(np.clip(w, 0.0, 1.0))},
                'pose': pose} for kind, w in sorted(weights.items(), key=lambda item: -item[1])]
    return {'header': header, 'detections': [{
        'header': header, 'id': str(track.id), 'results': results,
        'bbox': {'center': pose['pose'], 'size': {'x': float(track.length), 'y': 0.0, 'z': 0.0}}}]}
