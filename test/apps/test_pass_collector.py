"""Collection of passes from batches of readings."""

import numpy as np

from mag_tracking.pipeline import Pipeline, settings_for
from support.live_runs import passes_of
from support.passes import EARTH, ROAD
from support.samples import MagSample, batch


def test_an_empty_batch_is_accepted_while_a_reading_is_held():
    """A batch is empty if all readings of a message come from sensors outside the network."""
    rng = np.random.default_rng(0)

    def batches():
        for k in range(1000):
            # The reading before the empty batch is an outlier, which is held until the next one.
            yield batch([MagSample(
                10**18 + k * 10**7, name,
                EARTH + 5e-6 * (k == 600) + 1.2e-8 * rng.standard_normal(3))
                for name in ROAD.names])
            if k == 600:
                yield batch([])

    pipeline = Pipeline(ROAD, settings_for('vehicle'), 'detect')
    assert passes_of(ROAD, batches(), pipeline) == []
    assert pipeline.rejections() == {'spike': 2}
