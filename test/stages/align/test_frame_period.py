"""Frames by the geometry, and the warning where one is too long."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.errors import SettingsError
from mag_tracking.stages.align.frame_period import (
    frame_period,
    frame_period_warning,
    shortest_delay,
)
from mag_tracking.stages.align.settings import AlignSettings
from support.passes import ROAD, network_of

AUTO = AlignSettings()


@pytest.mark.parametrize('distance, period', [(9.0, 0.08), (2.1, 0.08), (1.6, 0.04), (1.0, 0.025),
                                              (0.5, 0.02), (0.2, 0.02), (0.05, 0.08)])
def test_a_frame_is_half_the_shortest_delay_of_a_close_network(distance, period):
    network = network_of([[0.0, 0.0, 0.0], [distance, 0.0, 0.0]])
    assert frame_period(AUTO, network) == pytest.approx(period)
    assert frame_period(dataclasses.replace(AUTO, burst=True), network) == 0.08
    wide = network_of([[0.0, 0.0, 0.0], [distance, 0.0, 0.0], [40.0, 0.0, 0.0]])
    assert frame_period(AUTO, wide) == 0.08


def test_height_is_no_delay():
    mast = network_of([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0]])
    assert shortest_delay(mast) is None and frame_period(AUTO, mast) == 0.08


def test_one_sensor_has_no_delay():
    one = network_of([[0.0, 0.0, 0.0]])
    assert shortest_delay(one) is None and frame_period(AUTO, one) == 0.08
    assert frame_period_warning(AUTO, one) is None


def test_a_setting_is_taken_as_it_is_and_warned_of():
    close = network_of([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]])
    long = dataclasses.replace(AUTO, period_s=0.08)
    assert frame_period(long, close) == 0.08
    said = frame_period_warning(long, close)
    assert '80 ms' in said and '25 ms' in said and 'mag_1 to mag_2' in said
    assert frame_period_warning(dataclasses.replace(long, burst=True), close) is None
    assert frame_period_warning(long, ROAD) is None
    # Nobody is warned of what was chosen for him.
    nearer = network_of([[0.0, 0.0, 0.0], [0.0, 0.2, 0.0]])
    assert frame_period_warning(AUTO, close) is None and frame_period_warning(AUTO, nearer) is None


def test_a_frame_shorter_than_any_reading_is_refused():
    with pytest.raises(SettingsError, match='shorter than'):
        frame_period(dataclasses.replace(AUTO, period_s=1e-9), ROAD)


def test_many_sensors_are_looked_at_quickly():
    rng = np.random.default_rng(1)
    network = network_of(rng.uniform(0.0, 100.0, (600, 3)))
    place = network.positions[:, :2]
    apart = np.linalg.norm(place[:, None] - place[None], axis=2)[np.triu_indices(600, 1)]
    assert shortest_delay(network)[0] == pytest.approx(apart[apart > 0.1].min() / 20.0)
