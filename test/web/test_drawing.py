"""Curves and regions on the pages, compared with independently computed values."""

import numpy as np
import pytest
from scipy.stats import chi2, norm

from mag_tracking.apps.replay_report import write_report
from support.browser import Page as Opened
from support.browser import browser, needs_browser

pytestmark = needs_browser

RECORDING = 'junction_left_turns_to_rear'


@pytest.fixture(scope='module')
def log(vehicle_replays):
    return vehicle_replays[RECORDING][0].logs[1]


@pytest.fixture(scope='module')
def page(vehicle_replays, road_network, tmp_path_factory):
    with browser() as chromium:
        run, _ = vehicle_replays[RECORDING]
        folder = tmp_path_factory.mktemp('report')
        found = Opened(chromium, write_report(run, road_network, folder).as_uri())
        found.wait('magTracking.drawn > 0')
        yield found


def show_pose(page, log, k):
    """Move the slider of the page to pose `k` of the log."""
    page.move_slider((log.stamp_ns[k] - log.stamp_ns[0]) / 1e9)


def trace(page, plot, name):
    """Points (2, n) of the trace in `plot` whose name starts with `name`."""
    found = page.value(f'''(() => {{
        const found = document.getElementById('{plot}').data.find(
          d => (d.name || '').startsWith('{name}'));
        return found ? [Array.from(found.x), Array.from(found.y)] : null; }})()''')
    assert found is not None, name
    return np.array(found, dtype=float)


def squared_mahalanobis(points, centre, C):
    """Squared Mahalanobis distances of points (2, n) from `centre` with the covariance `C`."""
    d = points - np.asarray(centre)[:2, None]
    return np.einsum('an,ab,bn->n', d, np.linalg.inv(C[:2, :2]), d)


@pytest.mark.parametrize('share', [0.0, 0.05, 0.3, 0.6, 1.0])
def test_the_region_is_the_90_percent_ellipse_of_the_covariance(page, log, share):
    k = round(share * (len(log.stamp_ns) - 1))
    show_pose(page, log, k)
    points = trace(page, 'map', '90 % region')
    np.testing.assert_allclose(squared_mahalanobis(points, log.position[k], log.covariance[k]),
                               chi2.ppf(0.9, 2), rtol=1e-3)


def test_hypotheses_are_drawn_with_their_weight_and_region(page, log):
    k = next(k for k, row in enumerate(log.arrivals)
             if sum(weight > 0.01 for weight, *_ in row.values()) > 1)
    show_pose(page, log, k)
    n = 0
    for name, (weight, position, C) in log.arrivals[k].items():
        if weight > 0.01:
            points = trace(page, 'map', f'from {name}, {round(100 * weight)} %')
            np.testing.assert_allclose(squared_mahalanobis(points, position, C),
                                       chi2.ppf(0.9, 2), rtol=1e-3)
            n += 1
    assert n > 1


def test_curves_match_the_track_log(page, log):
    t = (np.array(log.stamp_ns) - log.stamp_ns[0]) / 1e9
    speed = np.hypot(*np.array(log.velocity)[:, :2].T)
    x, y = trace(page, 'speed', 'speed')
    np.testing.assert_allclose(x, t, atol=1e-9)
    np.testing.assert_allclose(y, speed)
    u = np.array(log.velocity)[:, :2] / speed[:, None]
    std = np.sqrt(np.einsum('na,nab,nb->n', u, np.array(log.covariance)[:, 3:5, 3:5], u))
    np.testing.assert_allclose(trace(page, 'speed', '90 %')[1], speed + norm.ppf(0.95) * std,
                               rtol=1e-3)
    n = np.array(log.degrees_of_freedom)
    np.testing.assert_allclose(trace(page, 'innovation', '90 %')[1], chi2.ppf(0.95, n) / n,
                               rtol=1e-5)
    for name in ('left', 'right', 'rear'):
        weights = [row[name][0] if name in row else 0.0 for row in log.arrivals]
        np.testing.assert_allclose(trace(page, 'weights', name)[1], weights, atol=1e-6)
        assert max(weights) > 0.1


def test_measured_and_predicted_fields_match_the_track_log(page, log):
    panels = page.value('''[...document.querySelectorAll('#field .plot')].map(
        plot => plot.data.map(d => [d.name, Array.from(d.y)]))''')
    assert len(panels) == 2
    for j, panel in enumerate(panels):
        for name, values in panel:
            axis, kind = 'xyz'.index(name[0]), name[2:]
            np.testing.assert_allclose(np.array(values, dtype=float),
                                       1e9 * np.array(getattr(log, kind))[:, j, axis], rtol=1e-5)


def test_weights_of_all_arrivals_sum_to_one(page, log):
    """For each pose, the log contains the weights of all arrivals."""
    total = [sum(weight for weight, *_ in row.values()) for row in log.arrivals]
    np.testing.assert_allclose(total, 1.0, atol=1e-9)
