"""Names of topics: as a network file has them, and as a graph or a recording does."""

import re
from collections.abc import Collection, Iterable

from mag_tracking.errors import NetworkError

NAME = re.compile(r'/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*')
"""A relative or absolute name."""
_NAMESPACE = re.compile(r'/|(/[A-Za-z_][A-Za-z0-9_]*)+')


def absolute(topic: str, namespace: str = '/') -> str:
    """The absolute name of a topic in a namespace; one that begins with / stays as it is."""
    return topic if topic.startswith('/') else f'{namespace.rstrip("/")}/{topic}'


def namespaces_of(topics: Iterable[str], recorded: Collection[str]) -> list[str]:
    """The namespaces in which at least one of the relative `topics` was recorded, in order.

    The root, '/', alone where it is one of them.
    """
    found = {name.removesuffix(f'/{topic}') or '/' for topic in topics if not topic.startswith('/')
             for name in recorded if name.endswith(f'/{topic}')}
    return ['/'] if '/' in found else sorted(found)


def checked_namespace(namespace: str) -> str:
    """An absolute namespace; raises NetworkError for anything else."""
    if not _NAMESPACE.fullmatch(namespace):
        raise NetworkError(f'{namespace!r} is not a namespace: it begins with /, has letters, '
                           'digits and _, and no part of it begins with a digit')
    return namespace
