"""Recordings of simulated passes of a vehicle whose hard and soft iron are known."""

import numpy as np

from mag_tracking.analysis.pass_covariance import SensorErrors
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.network.file import read_network
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.simulation.scenario import Imperfections, Path, point_body
from support.bundled import NETWORK_FILE
from support.samples import sample_dict, simulate

HARD, SOFT = [240.0, -130.0, 90.0], 6.0
"""m0 [A m^2] in the vehicle's frame and D [m^3] of the simulated vehicle."""
ERRORS = Imperfections(tilt_std=SensorErrors().rotation_std, gain_std=SensorErrors().gain_std)
"""As the fit assumes them of sensors that are as they were bought."""
START_S, DURATION_S, SPEED = 1_000.0, 24.0, 10.0


def recorded(folder, heading_deg, rng, hard=HARD, soft=SOFT):
    """A recording of one pass, half of it before the closest point; its path."""
    network, heading = read_network(NETWORK_FILE), np.deg2rad(heading_deg)
    way = np.array([np.cos(heading), np.sin(heading)])
    start = np.array([0.3, 0.4]) - 0.5 * DURATION_S * SPEED * way
    samples, *_ = simulate(network, point_body(hard, soft, 0.5), Path(start, heading, SPEED),
                           100.0, DURATION_S, rng, ERRORS, start_s=START_S)
    path = folder / 'pass.mcap'
    with RecordingWriter(path) as writer:
        for s in samples:
            writer.write(f'/{s.sensor}/imu/mag', MAGNETIC_FIELD, sample_dict(s, s.sensor),
                         s.stamp_ns)
    return path.rename(folder / f'{folder.name}.mcap')
