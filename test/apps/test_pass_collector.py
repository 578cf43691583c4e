"""Collection of passes from batches of readings."""

import numpy as np

from mag_tracking.apps.pass_collector import PassCollector
from mag_tracking.pipeline import settings_for
from support.passes import EARTH, ROAD
from support.samples import MagSample, batch


def test_an_empty_batch_is_accepted_while_a_reading_is_held():
    """A batch is empty if all readings of a message come from sensors outside the network."""
    rng, passes = np.random.default_rng(0), []
    collector = PassCollector(ROAD, settings_for('vehicle'))

    def feed(k, offset=0.0):
        return collector.feed(batch([MagSample(
            10**18 + k * 10**7, name, EARTH + offset + 1.2e-8 * rng.standard_normal(3))
            for name in ROAD.names]))

    for k in range(1000):
        # The reading before the empty batch is an outlier, which is held until the next reading.
        passes += feed(k, 5e-6 * (k == 600))
        if k == 600:
            passes += collector.feed(batch([]))
    assert passes + collector.flush() == []
    assert collector.rejected == {'spike': 2}
