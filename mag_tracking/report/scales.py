"""Readable units of lengths and fields."""


def scale_of(extent: float) -> tuple[float, str]:
    """Factor from metres to a readable unit for lengths up to `extent` [m], and its symbol."""
    return (1.0, 'm') if extent > 1.0 else (1e3, 'mm')


def field_unit(strongest: float) -> tuple[float, str]:
    """Factor from tesla to a readable unit for fields up to `strongest` [T], and its symbol."""
    return (1e9, 'nT') if strongest < 1e-5 else (1e6, 'µT') if strongest < 1e-2 else (1e3, 'mT')
