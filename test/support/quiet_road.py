"""Recording of a road without vehicles."""

import numpy as np

from mag_tracking.messages.schema import magnetic_field_dicts
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.records import Readings
from mag_tracking.units import NS

BEGIN_NS = 1_790_000_000 * NS
NOISE, DRIFT, STEP = 1.2e-8, 3e-10, 6.25e-9
"""Noise of a reading [T], drift of the background [T/s^0.5], and quantisation step [T]."""


def write_quiet_road(path, network, duration_s, rate_hz=100.0, seed=0):
    """Write an .mcap file with readings of a network in a slightly drifting Earth field."""
    rng, n = np.random.default_rng(seed), round(duration_s * rate_hz)
    t_ns = BEGIN_NS + np.round(np.arange(n) * NS / rate_hz).astype(np.int64)
    with RecordingWriter(path) as writer:
        fields = []
        for R in network.R_sw:
            drift = np.cumsum(DRIFT / np.sqrt(rate_hz) * rng.standard_normal((n, 3)), axis=0)
            field = R @ np.array([2e-6, 1.55e-5, -4.9e-5]) + drift + NOISE * rng.standard_normal(
                (n, 3))
            fields.append(STEP * np.round(field / STEP))
        for k in range(n):
            for j, topic in enumerate(network.topics):
                stamp = t_ns[k:k + 1] + 1_000_000 * j
                (_, content), = magnetic_field_dicts(Readings(
                    (network.names[j],), np.zeros(1, dtype=np.int64), stamp, fields[j][k:k + 1]))
                writer.write(f'/{topic}', MAGNETIC_FIELD, content, int(stamp[0]))
