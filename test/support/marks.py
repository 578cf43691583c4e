"""Pytest marks for test parameters with long run times."""

import pytest


def studied(names, kept=(), also=lambda name: ()):
    """Mark all parameters except those in `kept` as studies, which only `make studies` runs.

    `also(name)` returns further marks of a parameter.
    """
    return [pytest.param(name, marks=[*also(name), *([] if name in kept else [pytest.mark.study])])
            for name in names]
