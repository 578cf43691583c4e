"""Units that make lengths and fields readable."""


def scale_of(extent: float) -> tuple[float, str]:
    """(factor, unit) that makes a length of `extent` metres readable."""
    return (1.0, 'm') if extent > 1.0 else (1e3, 'mm')


def field_unit(strongest: float) -> tuple[float, str]:
    """(factor, unit) that makes fields up to `strongest` [T] readable."""
    return (1e9, 'nT') if strongest < 1e-5 else (1e6, 'µT') if strongest < 1e-2 else (1e3, 'mT')
