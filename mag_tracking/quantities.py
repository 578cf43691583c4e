"""Formatting of numbers and their nouns in messages."""


def quantity(n: int, singular: str, plural: str = '') -> str:
    """Format a number and its noun, such as '1 track' or '2 tracks'.

    Parameters
    ----------
    n : int
    singular : str
        Noun for `n` = 1.
    plural : str
        Noun for any other number. By default, an s is appended to `singular`.

    Returns
    -------
    str
    """
    return f'{n} {singular if n == 1 else plural or singular + "s"}'
