"""The field of the Earth at a place and time, by the World Magnetic Model.

The model is that of pygeomag, which includes the coefficients of NOAA and the British
Geological Survey. T10 section 6.3.1 uses its declination.
"""

import datetime
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray

COEFFICIENTS = 'wmm/WMM_2025.COF'
"""Coefficient file of WMM2025 within pygeomag."""
FIRST_YEAR, LAST_YEAR = 2025.0, 2030.0
"""First and last year of WMM2025."""


@dataclass(frozen=True)
class Site:
    """Place and time of a network, and the orientation of its frame."""

    latitude: float
    """Geodetic latitude, deg, north positive."""
    longitude: float
    """Longitude, deg, east positive."""
    height: float
    """Height above the ellipsoid, m."""
    year: float
    """Decimal year."""
    x_azimuth: float
    """Bearing of the frame's x axis, deg, clockwise from true north: 90 for east (ENU), or the
    bearing of the road along which x points."""


def decimal_year(day: datetime.date) -> float:
    """Convert a date to a decimal year.

    Parameters
    ----------
    day : datetime.date

    Returns
    -------
    float
    """
    first = datetime.date(day.year, 1, 1)
    return day.year + (day - first).days / (datetime.date(day.year + 1, 1, 1) - first).days


def earth_field(site: Site) -> FloatArray:
    """Flux density of the Earth at a site.

    Parameters
    ----------
    site : Site

    Returns
    -------
    (3,) array, T, world frame (z up)

    Raises
    ------
    ValueError
        If the model does not cover the place or the year.
    ModuleNotFoundError
        If pygeomag is not installed.
    """
    # Required only for networks that define a site instead of a field.
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
