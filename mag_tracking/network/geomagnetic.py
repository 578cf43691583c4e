"""The Earth's field at a place and time, by the World Magnetic Model.

The model itself is pygeomag's, which ships the coefficients of NOAA and the British
Geological Survey; T10 section 6.3.1 uses its declination.
"""

import datetime
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray

COEFFICIENTS = 'wmm/WMM_2025.COF'
FIRST_YEAR, LAST_YEAR = 2025.0, 2030.0
"""The span of WMM2025."""


@dataclass(frozen=True)
class Site:
    """Where and when a network stands, and how its frame lies there."""

    latitude: float
    """[deg] geodetic, north positive."""
    longitude: float
    """[deg], east positive."""
    height: float
    """[m] above the ellipsoid."""
    year: float
    """With its fraction."""
    x_azimuth: float
    """[deg] Bearing of the frame's x axis, clockwise from true north: 90 for east (ENU), or the
    bearing of the road that x runs along."""


def decimal_year(day: datetime.date) -> float:
    """The year with its fraction of a `datetime.date`."""
    first = datetime.date(day.year, 1, 1)
    return day.year + (day - first).days / (datetime.date(day.year + 1, 1, 1) - first).days


def earth_field(site: Site) -> FloatArray:
    """Flux density of the Earth at a `Site`.

    Returns
    -------
    (3,) [T], world (z up)

    Raises ValueError for a place or a year that the model does not cover, and
    ModuleNotFoundError without pygeomag.
    """
    # Only who gives a site instead of a field needs it.
    from pygeomag import GeoMag

    for name, value, low, high, unit in (
            ('latitude', site.latitude, -90.0, 90.0, 'deg'),
            ('longitude', site.longitude, -180.0, 360.0, 'deg'),
            ('height', site.height, -1000.0, 850e3, 'm'),
            ('year', site.year, FIRST_YEAR, LAST_YEAR, '(WMM2025)'),
            ('x_azimuth', site.x_azimuth, -360.0, 360.0, 'deg')):
        if not low <= value <= high:
            raise ValueError(f'{name}: {value:g} is outside {low:g} .. {high:g} {unit}')
    found = GeoMag(coefficients_file=COEFFICIENTS).calculate(
        glat=site.latitude, glon=site.longitude, alt=site.height * 1e-3, time=site.year)
    north, east, down = np.array([found.x, found.y, found.z]) * 1e-9
    azimuth = np.deg2rad(site.x_azimuth)
    return np.array([north * np.cos(azimuth) + east * np.sin(azimuth),
                     north * np.sin(azimuth) - east * np.cos(azimuth), -down])
