"""Picture of a pass, compared with the recording from which it is drawn."""

import json

import numpy as np
import pytest

import mag_tracking as mt
from mag_tracking.report.figures import N_VEHICLES
from support.bundled import DATA


@pytest.fixture(scope='module')
def corridor():
    """Result of the corridor recording, and its picture."""
    folder = DATA / 'corridor'
    result = mt.track(folder / 'corridor_8_sensors.mcap', folder / 'network.yaml')
    return result, result.pass_figure(max_std=1.0)


def blue_shapes(figure):
    """Outlines (n, 2) of the filled shapes of the vehicles: the opaque ones with a white edge."""
    return [patch.get_path().vertices for patch in figure.axes[0].patches
            if patch.get_edgecolor()[:3] == (1.0, 1.0, 1.0)]


def test_vehicles_are_drawn_to_scale_at_published_poses(corridor):
    result, figure = corridor
    truth = json.loads((DATA / 'corridor' / 'corridor_8_sensors.truth.json').read_text())
    (vehicle,) = truth['vehicles']
    shapes = blue_shapes(figure)
    assert len(shapes) == N_VEHICLES
    for shape in shapes:
        assert np.ptp(shape[:, 0]) == pytest.approx(vehicle['length_m'], abs=1.0)
        assert np.ptp(shape[:, 1]) == pytest.approx(vehicle['width_m'], abs=0.3)
        middle = 0.5 * (shape.min(axis=0) + shape.max(axis=0))
        assert np.hypot(*(result.poses['position'][:, :2] - middle).T).min() < 1e-6


def test_the_picture_names_all_sensors_and_times(corridor):
    result, figure = corridor
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert {*result.network.names} <= {*texts}
    assert sum(text.endswith(' s') for text in texts) == N_VEHICLES
    axes = figure.axes[0]
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    width, height = figure.get_size_inches() * axes.get_position().size
    assert (x1 - x0) / width == pytest.approx((y1 - y0) / height)
