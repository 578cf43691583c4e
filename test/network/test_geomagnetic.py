"""World Magnetic Model: official test values, rotation to the local frame, range of validity."""

import datetime

import numpy as np
import pytest

from mag_tracking.network.file import decimal_year, earth_field
from support.bundled import DATA

ROWS = np.loadtxt(DATA / 'WMM2025_TEST_VALUES.txt')
LINKOPING = {'latitude': 58.4, 'longitude': 15.6, 'height': 60.0, 'year': 2026.33,
             'x_azimuth': 90.0}


def test_every_official_test_value_is_reproduced():
    """The declination agrees within 0.0051 degrees (two decimals), the field within 2 nT."""
    assert len(ROWS) == 100
    max_errors = np.zeros(4)
    for year, km, latitude, longitude, declination, _, _, x, y, z in ROWS[:, :10]:
        # x points north, so y points west.
        north, west, up = 1e9 * earth_field(latitude, longitude, 1e3 * km, year, 0.0)
        error = np.degrees(np.arctan2(-west, north)) - declination
        max_errors = np.maximum(max_errors, np.abs([(error + 180.0) % 360.0 - 180.0,
                                                    north - x, -west - y, -up - z]))
    print(f'WMM2025: maximum error {max_errors[0]:.4f} degrees, {max_errors[1:].round(3)} nT')
    assert max_errors[0] <= 0.0051
    assert max_errors[1:].max() < 2.0


def test_the_field_is_rotated_by_the_azimuth_of_the_x_axis():
    north, west, up = earth_field(**LINKOPING | {'x_azimuth': 0.0})
    # The x axis points east, then south, then south-west.
    np.testing.assert_allclose(earth_field(**LINKOPING), [-west, north, up], rtol=1e-9)
    np.testing.assert_allclose(earth_field(**LINKOPING | {'x_azimuth': 180.0}),
                               [-north, -west, up], rtol=1e-9)
    c = np.sqrt(0.5)
    np.testing.assert_allclose(earth_field(**LINKOPING | {'x_azimuth': 225.0}),
                               [c * (west - north), -c * (north + west), up], rtol=1e-9)
    np.testing.assert_allclose(earth_field(**LINKOPING | {'x_azimuth': -90.0}),
                               earth_field(**LINKOPING | {'x_azimuth': 270.0}), rtol=1e-9)


def test_the_field_in_sweden_points_north_and_down():
    east, north, up = earth_field(**LINKOPING)
    assert 1.4e-5 < north < 1.7e-5 and 0.0 < east < 3e-6 and -5.2e-5 < up < -4.7e-5


def test_the_field_at_a_pole_is_the_limit_of_the_field_beside_it():
    for latitude in (-90.0, 90.0):
        site = LINKOPING | {'latitude': latitude}
        beside = earth_field(**site | {'latitude': latitude * (1.0 - 1e-7)})
        np.testing.assert_allclose(earth_field(**site), beside, atol=1e-9)


def test_the_field_is_linear_in_time():
    days = (2026.0, 2026.5, 2026.501, 2027.0)
    first, *between, last = (earth_field(**LINKOPING | {'year': year}) for year in days)
    for year, field in zip(days[1:], between, strict=False):
        np.testing.assert_allclose(field, first + (year - 2026.0) * (last - first), atol=1e-13)


def test_longitudes_are_periodic():
    np.testing.assert_allclose(earth_field(**LINKOPING | {'longitude': -70.0}),
                               earth_field(**LINKOPING | {'longitude': 290.0}), rtol=1e-12)


@pytest.mark.parametrize('change, message', [
    ({'latitude': 90.1}, 'latitude: 90.1 is outside'), ({'longitude': 361.0}, 'longitude'),
    ({'height': -2000.0}, 'height'), ({'height': 1e6}, 'height'),
    ({'year': 2024.9}, 'year: 2024.9 is outside 2025 .. 2030'), ({'year': 2030.5}, 'year'),
    ({'x_azimuth': 400.0}, 'x_azimuth'), ({'latitude': float('nan')}, 'latitude'),
    ({'year': float('nan')}, 'year'), ({'longitude': float('inf')}, 'longitude')])
def test_sites_outside_the_range_of_the_model_are_rejected(change, message):
    with pytest.raises(ValueError, match=message):
        earth_field(**LINKOPING | change)


@pytest.mark.parametrize('change', [{'latitude': 90.0}, {'latitude': -90.0}, {'longitude': 360.0},
                                    {'year': 2025.0}, {'year': 2030.0}, {'height': 850e3}])
def test_sites_at_the_limits_of_the_model_are_accepted(change):
    assert 2e-5 < np.linalg.norm(earth_field(**LINKOPING | change)) < 7e-5


@pytest.mark.parametrize('day, year', [
    ((2026, 1, 1), 2026.0), ((2026, 7, 2), 2026.0 + 182 / 365), ((2028, 7, 1), 2028 + 182 / 366),
    ((2027, 12, 31), 2027 + 364 / 365)])
def test_the_decimal_year_includes_the_fraction_of_the_year(day, year):
    assert decimal_year(datetime.date(*day)) == pytest.approx(year, abs=1e-12)
