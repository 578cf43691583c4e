"""Readable units of lengths and fields."""


def scale_of(extent: float) -> tuple[float, str]:
    """Select a readable unit for lengths up to a given extent.

    Parameters
    ----------
    extent : float, m

    Returns
    -------
    factor : float
        Factor from metres to the unit.
    unit : str
        Symbol of the unit.
    """
    return (1.0, 'm') if extent > 1.0 else (1e3, 'mm')


def field_unit(strongest: float) -> tuple[float, str]:
    """Select a readable unit for flux densities up to a given magnitude.

    Parameters
    ----------
    strongest : float, T
        Largest magnitude.

    Returns
    -------
    factor : float
        Factor from tesla to the unit.
    unit : str
        Symbol of the unit.
    """
    return (1e9, 'nT') if strongest < 1e-5 else (1e6, 'µT') if strongest < 1e-2 else (1e3, 'mT')
