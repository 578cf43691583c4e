"""Recordings of simulated passes of a vehicle with known hard and soft iron."""

import numpy as np

from mag_tracking.analysis.pass_description import SensorErrors
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.network.file import read_network
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.simulation.scenario import Path
from support.bundled import NETWORK_FILE
from support.samples import sample_dict, simulate
from support.scenario import SensorErrorModel, point_body

HARD, SOFT = [240.0, -130.0, 90.0], 6.0
"""Hard iron m0 [A m²] in the vehicle frame and soft iron D [m³] of the simulated vehicle."""
ERRORS = SensorErrorModel(tilt_std=SensorErrors().rotation_std, gain_std=SensorErrors().gain_std)
"""Errors of uncalibrated sensors, as assumed by the fit."""
START_S, DURATION_S, SPEED = 1_000.0, 24.0, 10.0


def recorded(folder, heading_deg, rng, hard=HARD, soft=SOFT):
    """Record one pass with the CPA in the middle; return the path of the recording."""
    network, heading = read_network(NETWORK_FILE), np.deg2rad(heading_deg)
    along = np.array([np.cos(heading), np.sin(heading)])
    start = np.array([0.3, 0.4]) - 0.5 * DURATION_S * SPEED * along
    samples, *_ = simulate(network, point_body(hard, soft, 0.5), Path(start, heading, SPEED),
                           100.0, DURATION_S, rng, ERRORS, start_s=START_S)
    path = folder / 'pass.mcap'
    with RecordingWriter(path) as writer:
        for s in samples:
            writer.write(f'/{s.sensor}/imu/mag', MAGNETIC_FIELD, sample_dict(s, s.sensor),
                         s.stamp_ns)
    return path.rename(folder / f'{folder.name}.mcap')
