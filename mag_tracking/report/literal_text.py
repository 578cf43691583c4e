"""Escaping of strings that figures draw literally."""

_ZERO_WIDTH_SPACE = '\u200b'


def literal(text: str) -> str:
    r"""Escape a string so that matplotlib draws it character by character.

    Matplotlib parses text between two `$` as mathematics, and fails on invalid mathematics such as
    `$\road$`. It omits labels that begin with `_` from a legend. Unpaired surrogates, which stand
    for bytes of a file name that are not UTF-8, are escaped as in `\udcff`.
    """
    drawable = text.encode('utf-8', 'backslashreplace').decode()
    escaped = drawable.replace('$', r'\$')
    return _ZERO_WIDTH_SPACE + escaped if escaped.startswith('_') else escaped
