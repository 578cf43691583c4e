"""Colours of figures and pages that people with colour blindness can distinguish."""

BLUE, VERMILLION, GREEN, ORANGE, PINK, SKY = (
    '#0072B2', '#D55E00', '#009E73', '#E69F00', '#CC79A7', '#56B4E9')
"""Palette of Okabe and Ito 2008, Color universal design."""
SERIES_COLOURS = (BLUE, ORANGE, GREEN, PINK, SKY)
"""Colours of curves, in order; vermillion is reserved for smoothed tracks."""
AXIS_COLOURS = (VERMILLION, GREEN, BLUE)
"""Colours of the axes x, y, z."""
