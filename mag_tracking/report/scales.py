"""Units in which lengths and fields are readable."""


def scale_of(extent: float) -> tuple[float, str]:
    """Return the unit for lengths of a given extent.

    Parameters
    ----------
    extent : float, m

    Returns
    -------
    factor : float
        From metres to the unit.
    unit : str
    """
    return (1.0, 'm') if extent > 1.0 else (1e3, 'mm')


def field_unit(strongest: float) -> tuple[float, str]:
    """Return the unit for fields up to a given strength.

    Parameters
    ----------
    strongest : float, T

    Returns
    -------
    factor : float
        From tesla to the unit.
    unit : str
    """
    return (1e9, 'nT') if strongest < 1e-5 else (1e6, 'µT') if strongest < 1e-2 else (1e3, 'mT')
