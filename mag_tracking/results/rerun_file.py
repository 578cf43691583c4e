"""Recordings for the Rerun viewer, which require the optional package rerun-sdk."""

import sys
from collections.abc import Mapping
from importlib.util import find_spec
from os import PathLike
from typing import Any

import numpy as np
from scipy.special import chdtri

from mag_tracking.analysis.track_log import SmoothedLog, TrackLog
from mag_tracking.arrays import FloatArray
from mag_tracking.errors import MissingDependencyError, OutputError
from mag_tracking.files import new_binary_file
from mag_tracking.geometry import quaternion_from_rotation
from mag_tracking.network import SensorNetwork
from mag_tracking.units import NS

RERUN_FILE = 'tracks.rrd'
"""File name of the Rerun recording in a result folder."""
TIME = 'stamp'
"""Name of the timeline."""
MIN_MOMENT = 1e-12
"""Minimum magnitude by which a moment is divided to obtain its direction [A m²]."""
SCALE_3D = float(np.sqrt(chdtri(3, 0.1)))
"""Radius of a 90 % ellipsoid, in standard deviations."""


def check_rerun() -> None:
    """Raise MissingDependencyError if rerun-sdk is not installed."""
    if find_spec('rerun') is None:
        raise MissingDependencyError(
            'Rerun recordings require the package rerun-sdk; install it with: '
            f'{sys.executable} -m pip install rerun-sdk')


def write_rerun(path: str | PathLike[str], network: SensorNetwork, logs: Mapping[int, TrackLog],
                smoothed: Mapping[int, SmoothedLog]) -> None:
    """Write sensors and tracks (poses, 90 % regions, speeds, fields) to a Rerun recording.

    `logs` and `smoothed` are by track id. Raises MissingDependencyError without rerun-sdk, and
    OutputError if the file cannot be written.
    """
    check_rerun()
    import rerun

    stream = rerun.RecordingStream('mag_tracking')
    try:
        # Create a new file first, so that a link of this name is not followed.
        new_binary_file(path).close()
        stream.save(path)
    except (OSError, RuntimeError) as error:
        raise OutputError(f'cannot write {path}: {error}') from error
    stream.log(f'{network.frame}/sensors', rerun.Points3D(
        network.positions, labels=list(network.names)), static=True)
    for log in logs.values():
        _write_track(rerun, stream, network, log)
    for track in smoothed.values():
        stream.log(f'{network.frame}/track_{track.id}/smoothed', rerun.LineStrips3D(
            [np.array(track.position)]), static=True)
    stream.flush()
    stream.disconnect()


def _write_track(rerun: Any, stream: Any, network: SensorNetwork, log: TrackLog) -> None:
    """Log the poses of a track, and clear the track one period after its last pose."""
    root = f'{network.frame}/track_{log.id}'
    for k, ns in enumerate(log.stamp_ns):
        stream.set_time(TIME, timestamp=np.datetime64(ns, 'ns'))
        half_axes, orientation = _ellipsoid(log.covariance[k][:3, :3])
        stream.log(f'{root}/region', rerun.Ellipsoids3D(
            centers=[log.position[k]], half_sizes=[half_axes],
            quaternions=[rerun.Quaternion(xyzw=orientation)]))
        stream.log(f'{root}/pose', rerun.Points3D([log.position[k]], labels=[
            f'{log.id} {log.kind[k]}{"?" if log.ambiguous[k] else ""}']))
        magnitude = max(float(np.linalg.norm(log.moment[k])), MIN_MOMENT)
        stream.log(f'{root}/moment', rerun.Arrows3D(
            origins=[log.position[k]], vectors=[log.moment[k] / magnitude]))
        stream.log(f'speed/track_{log.id}', rerun.Scalars(float(np.hypot(*log.velocity[k][:2]))))
        for j, name in enumerate(network.names):
            for source, fields in (('measured', log.measured[k]), ('predicted', log.predicted[k])):
                stream.log(f'field/{name}/{source}', rerun.Scalars(1e9 * fields[j]))
    # The last pose stays visible for one period.
    period = log.stamp_ns[-1] - log.stamp_ns[-2] if len(log.stamp_ns) > 1 else NS
    stream.set_time(TIME, timestamp=np.datetime64(log.stamp_ns[-1] + period, 'ns'))
    stream.log(root, rerun.Clear(recursive=True))


def _ellipsoid(C: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Semi-axes (3,) [m] and quaternion xyzw of the 90 % ellipsoid of a covariance."""
    values, R = np.linalg.eigh(C)
    if np.linalg.det(R) < 0.0:
        R = -R
    half: FloatArray = SCALE_3D * np.sqrt(np.maximum(values, 0.0))
    return half, quaternion_from_rotation(R)
