"""The World Magnetic Model: the official test values, the frame, and what it does not cover."""

import datetime
from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.network.geomagnetic import Site, decimal_year, earth_field
from support.bundled import DATA

ROWS = np.loadtxt(DATA / 'WMM2025_TEST_VALUES.txt')
LINKOPING = Site(58.4, 15.6, 60.0, 2026.33, 90.0)


def test_every_official_value_is_met():
    """Declination to its two digits, the components to a few nanotesla."""
    assert len(ROWS) == 100
    worst = np.zeros(4)
    for year, km, latitude, longitude, declination, _, _, x, y, z in ROWS[:, :10]:
        # x to the north, so that y is to the west.
        north, west, up = 1e9 * earth_field(Site(latitude, longitude, 1e3 * km, year, 0.0))
        off = np.degrees(np.arctan2(-west, north)) - declination
        worst = np.maximum(worst, np.abs([(off + 180.0) % 360.0 - 180.0,
                                          north - x, -west - y, -up - z]))
    print(f'WMM2025: at most {worst[0]:.4f} degrees, {worst[1:].round(3)} nT off')
    assert worst[0] <= 0.0051
    assert worst[1:].max() < 2.0


def test_the_frame_is_turned_as_the_bearing_of_its_x_axis_says():
    north, west, up = earth_field(replace(LINKOPING, x_azimuth=0.0))
    # East, north, up; and a road to the south-west.
    np.testing.assert_allclose(earth_field(LINKOPING), [-west, north, up], rtol=1e-9)
    np.testing.assert_allclose(earth_field(replace(LINKOPING, x_azimuth=180.0)),
                               [-north, -west, up], rtol=1e-9)
    c = np.sqrt(0.5)
    np.testing.assert_allclose(earth_field(replace(LINKOPING, x_azimuth=225.0)),
                               [c * (west - north), -c * (north + west), up], rtol=1e-9)
    np.testing.assert_allclose(earth_field(replace(LINKOPING, x_azimuth=-90.0)),
                               earth_field(replace(LINKOPING, x_azimuth=270.0)), rtol=1e-9)


def test_in_sweden_it_points_north_and_down():
    east, north, up = earth_field(LINKOPING)
    assert 1.4e-5 < north < 1.7e-5 and 0.0 < east < 3e-6 and -5.2e-5 < up < -4.7e-5


def test_a_longitude_may_be_counted_either_way():
    np.testing.assert_allclose(earth_field(replace(LINKOPING, longitude=-70.0)),
                               earth_field(replace(LINKOPING, longitude=290.0)), rtol=1e-12)


@pytest.mark.parametrize('change, message', [
    ({'latitude': 90.1}, 'latitude: 90.1 is outside'), ({'longitude': 361.0}, 'longitude'),
    ({'height': -2000.0}, 'height'), ({'height': 1e6}, 'height'),
    ({'year': 2024.9}, 'year: 2024.9 is outside 2025 .. 2030'), ({'year': 2030.5}, 'year'),
    ({'x_azimuth': 400.0}, 'x_azimuth'), ({'latitude': float('nan')}, 'latitude'),
    ({'year': float('nan')}, 'year'), ({'longitude': float('inf')}, 'longitude')])
def test_what_the_model_does_not_cover_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        earth_field(replace(LINKOPING, **change))


@pytest.mark.parametrize('change', [{'latitude': 90.0}, {'latitude': -90.0}, {'longitude': 360.0},
                                    {'year': 2025.0}, {'year': 2030.0}, {'height': 850e3}])
def test_the_ends_of_the_span_are_covered(change):
    assert 2e-5 < np.linalg.norm(earth_field(replace(LINKOPING, **change))) < 7e-5


@pytest.mark.parametrize('day, year', [
    ((2026, 1, 1), 2026.0), ((2026, 7, 2), 2026.0 + 182 / 365), ((2028, 7, 1), 2028 + 182 / 366),
    ((2027, 12, 31), 2027 + 364 / 365)])
def test_the_year_with_its_fraction(day, year):
    assert decimal_year(datetime.date(*day)) == pytest.approx(year, abs=1e-12)
