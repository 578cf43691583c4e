"""Formatting of numbers with their nouns in messages."""


def quantity(n: int, singular: str, plural: str = '') -> str:
    """Format a number and its noun, such as '1 track' or '2 tracks'; by default, add an s."""
    return f'{n} {singular if n == 1 else plural or singular + "s"}'


def occurrences(n: int) -> str:
    """Format a number of occurrences, such as 'once' or '2 times'."""
    return 'once' if n == 1 else f'{n} times'
