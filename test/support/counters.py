"""Counters that are identified by a term of their name, whatever its wording."""


def count_of(counts, term):
    """Value of the only counter whose name contains `term`; 0 without such a counter."""
    found = {name: n for name, n in counts.items() if term in name}
    assert len(found) <= 1, found
    return sum(found.values())


def assert_counts(counts, expected):
    """Assert that the counters are those of `expected`: {term of the name: value}."""
    assert {term: count_of(counts, term) for term in expected} == expected, counts
    assert len(counts) == len(expected), counts
