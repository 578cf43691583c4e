"""Marks of test parameters."""

import pytest


def studied(names, kept=(), also=lambda name: ()):
    """Parameters: those in `kept` run in `make test`, the others in `make studies`."""
    return [pytest.param(name, marks=[*also(name), *([] if name in kept else [pytest.mark.study])])
            for name in names]
