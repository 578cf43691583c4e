"""Marks of parameters."""

import pytest


def studied(names, kept=(), also=lambda name: ()):
    """Parameters: those in `kept` for every `make test`, the others for `make studies`; `also`
    gives further marks."""
    return [pytest.param(name, marks=[*also(name), *([] if name in kept else [pytest.mark.study])])
            for name in names]
