"""Passes are cut out of batches of readings, whatever the batches hold."""

import numpy as np

from mag_tracking.apps.pass_collector import PassCollector
from mag_tracking.pipeline import settings_for
from support.passes import EARTH, ROAD
from support.samples import MagSample, batch


def test_a_batch_without_readings_may_come_while_one_is_held():
    """A message may hold nothing but readings of sensors that the network does not have."""
    rng, passes = np.random.default_rng(0), []
    collector = PassCollector(ROAD, settings_for('vehicle'))

    def feed(k, offset=0.0):
        return collector.feed(batch([MagSample(
            10**18 + k * 10**7, name, EARTH + offset + 1.2e-8 * rng.standard_normal(3))
            for name in ROAD.names]))

    for k in range(1000):
        # The last before the empty batch is steeply off: it is held until the next tells.
        passes += feed(k, 5e-6 * (k == 600))
        if k == 600:
            passes += collector.feed(batch([]))
    assert passes + collector.flush() == []
    assert collector.rejected == {'spike': 2}
