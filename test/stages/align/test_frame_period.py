"""Frame period from the geometry of the network, and warning about a long configured period."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.errors import SettingsError
from mag_tracking.stages.align.stage import frame_period, frame_period_warning, shortest_delay
from mag_tracking.stages.settings import AlignSettings
from support.passes import ROAD, network_of

AUTO = AlignSettings()


@pytest.mark.parametrize('distance, period', [(9.0, 0.08), (2.1, 0.08), (1.6, 0.04), (1.0, 0.025),
                                              (0.5, 0.02), (0.2, 0.02), (0.05, 0.08)])
def test_the_period_is_half_the_shortest_delay_in_a_compact_network(distance, period):
    network = network_of([[0.0, 0.0, 0.0], [distance, 0.0, 0.0]])
    assert frame_period(AUTO, network) == pytest.approx(period)
    assert frame_period(dataclasses.replace(AUTO, burst=True), network) == 0.08
    wide = network_of([[0.0, 0.0, 0.0], [distance, 0.0, 0.0], [40.0, 0.0, 0.0]])
    assert frame_period(AUTO, wide) == 0.08


def test_sensors_above_each_other_have_no_delay():
    mast = network_of([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0]])
    assert shortest_delay(mast) is None and frame_period(AUTO, mast) == 0.08


def test_a_single_sensor_has_no_delay():
    single = network_of([[0.0, 0.0, 0.0]])
    assert shortest_delay(single) is None and frame_period(AUTO, single) == 0.08
    assert frame_period_warning(AUTO, single) is None


def test_a_configured_period_is_used_and_warned_about():
    compact = network_of([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]])
    long_period = dataclasses.replace(AUTO, period_s=0.08)
    assert frame_period(long_period, compact) == 0.08
    warning = frame_period_warning(long_period, compact)
    assert '80 ms' in warning and '25 ms' in warning and 'mag_1 to mag_2' in warning
    assert frame_period_warning(dataclasses.replace(long_period, burst=True), compact) is None
    assert frame_period_warning(long_period, ROAD) is None
    # There is no warning about an automatic period.
    more_compact = network_of([[0.0, 0.0, 0.0], [0.0, 0.2, 0.0]])
    assert frame_period_warning(AUTO, compact) is None \
        and frame_period_warning(AUTO, more_compact) is None


def test_a_period_below_the_minimum_is_refused():
    with pytest.raises(SettingsError, match='shorter than'):
        frame_period(dataclasses.replace(AUTO, period_s=1e-9), ROAD)


def test_the_shortest_delay_is_exact_in_a_large_network():
    rng = np.random.default_rng(1)
    network = network_of(rng.uniform(0.0, 100.0, (600, 3)))
    plane = network.positions[:, :2]
    distance = np.linalg.norm(plane[:, None] - plane[None], axis=2)[
        np.triu_indices(600, 1)]
    assert shortest_delay(network)[0] == pytest.approx(distance[distance > 0.1].min() / 20.0)
