"""Road inferred from paths and sensor positions, for roads of known place and direction."""

import numpy as np
import pytest

from mag_tracking.report.road import LANE_WIDTH_M, SHOULDER_M, road_of


def rotated(points, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points) @ np.array([[c, s], [-s, c]])


def straight(y, half=15.0):
    return np.column_stack([np.linspace(-half, half, 60), np.full(60, y)])


def lateral_range(area, angle):
    """Range (low, high) [m] of an area across a road with the direction `angle`."""
    y = rotated(area, -angle)[:, 1]
    return y.min(), y.max()


@pytest.mark.parametrize('angle', [0.0, 0.4, np.pi / 2, 3.0])
def test_a_road_between_sensors_ends_before_them(angle):
    sensors = rotated([[0.0, -5.5], [0.0, 5.5]], angle)
    road = road_of(sensors, [rotated(straight(-1.8), angle), rotated(straight(1.7)[::-1], angle)])
    (area,) = road.areas
    np.testing.assert_allclose(lateral_range(area, angle),
                               (-5.5 + SHOULDER_M, 5.5 - SHOULDER_M), atol=1e-6)
    (marking,) = road.markings
    np.testing.assert_allclose(rotated(marking, -angle)[:, 1], 0.0, atol=1e-6)


def test_a_road_beside_sensors_is_where_the_vehicles_pass():
    sensors = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])
    road = road_of(sensors, [straight(3.0), straight(6.5)])
    (area,) = road.areas
    np.testing.assert_allclose(lateral_range(area, 0.0),
                               (3.0 - LANE_WIDTH_M / 2, 6.5 + LANE_WIDTH_M / 2), atol=1e-6)


def test_a_turning_vehicle_adds_a_side_road():
    """A car passes between the sensors and turns right 5 m behind them."""
    t = np.linspace(0.0, 0.5 * np.pi, 20)
    turn = np.column_stack([2.0 + 3.0 * np.sin(t), -4.0 + 3.0 * np.cos(t)])
    path = np.vstack([straight(-1.0)[:33], turn, np.column_stack([
        np.full(20, 5.0), np.linspace(-4.5, -14.0, 20)])])
    # A second vehicle on the same way adds nothing.
    road = road_of(np.array([[0.0, -4.5], [0.0, 4.5]]), [path, path + [0.3, -0.2]])
    main, side = road.areas
    for x in (-10.0, 10.0):
        np.testing.assert_allclose([np.interp(x, *edge.T) for edge in (main[:2], main[:1:-1])],
                                   (-3.5, 3.5), atol=0.15)
    below = side[side[:, 1] < -5.0]
    assert below[:, 0].min() == pytest.approx(5.0 - LANE_WIDTH_M / 2, abs=0.05)
    assert below[:, 0].max() == pytest.approx(5.0 + LANE_WIDTH_M / 2, abs=0.05)
    # The side road continues beyond the path.
    assert below[:, 1].min() < -50.0


@pytest.mark.parametrize('paths', [[], [np.zeros((5, 2))]])
def test_without_a_moving_vehicle_there_is_no_road(paths):
    road = road_of(np.array([[0.0, -4.5], [0.0, 4.5]]), paths)
    assert not road.areas and not road.markings
