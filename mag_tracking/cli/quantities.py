"""Numbers of things in printed lines."""


def quantity(n: int, noun: str, plural: str = '') -> str:
    """Format a number of things, with the noun in the singular or the plural.

    Parameters
    ----------
    n : int
    noun : str
        Noun in the singular.
    plural : str, optional
        By default, `noun` with an s.

    Returns
    -------
    str

    Examples
    --------
    >>> quantity(1, 'track'), quantity(2, 'track'), quantity(0, 'pass', 'passes')
    ('1 track', '2 tracks', '0 passes')
    """
    return f'{n} {noun if n == 1 else plural or f"{noun}s"}'
