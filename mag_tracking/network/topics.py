"""Resolution and validation of topic names and namespaces."""

import re
from collections.abc import Collection, Iterable

from mag_tracking.errors import NetworkError

TOPIC_NAME_PATTERN = re.compile(r'/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*')
"""Pattern of a valid relative or absolute topic name."""
_NAMESPACE_PATTERN = re.compile(r'/|(/[A-Za-z_][A-Za-z0-9_]*)+')


def absolute(topic: str, namespace: str = '/') -> str:
    """Resolve a topic name in a namespace; an absolute name is returned unchanged."""
    return topic if topic.startswith('/') else f'{namespace.rstrip("/")}/{topic}'


def namespaces_of(topics: Iterable[str], recorded: Collection[str]) -> list[str]:
    """Namespaces, in alphabetical order, in which at least one relative topic was recorded.

    Absolute `topics` are ignored. If the root namespace '/' is among them, it is the only one.
    """
    namespaces = {name.removesuffix(f'/{topic}') or '/'
                  for topic in topics if not topic.startswith('/')
                  for name in recorded if name.endswith(f'/{topic}')}
    return ['/'] if '/' in namespaces else sorted(namespaces)


def checked_namespace(namespace: str) -> str:
    """Return a valid absolute namespace unchanged; raises NetworkError for any other."""
    if not _NAMESPACE_PATTERN.fullmatch(namespace):
        raise NetworkError(f'{namespace!r} is not a valid namespace: it must begin with / and '
                           'contain only letters, digits and _; no part may begin with a digit')
    return namespace
