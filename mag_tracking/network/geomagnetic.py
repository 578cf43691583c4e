"""Magnetic field of the Earth at a place and time, from the World Magnetic Model (WMM).

The model is evaluated by pygeomag, which contains the coefficients published by NOAA and the
British Geological Survey. T10 section 6.3.1 uses the declination of the model.
"""

import datetime
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray

COEFFICIENTS = 'wmm/WMM_2025.COF'
"""Coefficient file of WMM2025, relative to the pygeomag package."""
FIRST_YEAR, LAST_YEAR = 2025.0, 2030.0
"""Period of validity of WMM2025, decimal years."""


@dataclass(frozen=True)
class Site:
    """Place and date of a network, and orientation of its frame."""

    latitude: float
    """Geodetic latitude, deg, north positive."""
    longitude: float
    """Longitude, deg, east positive."""
    height: float
    """Height above the ellipsoid, m."""
    year: float
    """Decimal year."""
    x_azimuth: float
    """Bearing of the x axis of the frame, deg, clockwise from true north: 90 for ENU, or the
    bearing of a road that is parallel to x."""


def decimal_year(day: datetime.date) -> float:
    """Convert a date to a decimal year."""
    first = datetime.date(day.year, 1, 1)
    return day.year + (day - first).days / (datetime.date(day.year + 1, 1, 1) - first).days


def earth_field(site: Site) -> FloatArray:
    """Magnetic flux density (3,) of the Earth at a site, T, world frame (z up).

    Raises ValueError if the model does not cover the place or the year, and ModuleNotFoundError
    without pygeomag.
    """
    # Optional dependency, required only for networks that define a site instead of a field.
    from pygeomag import GeoMag

    for name, value, low, high, unit in (
            ('latitude', site.latitude, -90.0, 90.0, 'deg'),
            ('longitude', site.longitude, -180.0, 360.0, 'deg'),
            ('height', site.height, -1000.0, 850e3, 'm'),
            ('year', site.year, FIRST_YEAR, LAST_YEAR, '(WMM2025)'),
            ('x_azimuth', site.x_azimuth, -360.0, 360.0, 'deg')):
        if not low <= value <= high:
            raise ValueError(f'{name}: {value:g} is outside {low:g} .. {high:g} {unit}')
    field = GeoMag(coefficients_file=COEFFICIENTS).calculate(
        glat=site.latitude, glon=site.longitude, alt=site.height * 1e-3, time=site.year)
    north, east, down = np.array([field.x, field.y, field.z]) * 1e-9
    azimuth = np.deg2rad(site.x_azimuth)
    return np.array([north * np.cos(azimuth) + east * np.sin(azimuth),
                     north * np.sin(azimuth) - east * np.cos(azimuth), -down])
