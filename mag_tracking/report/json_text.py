"""JSON without NaN, which is not valid JSON."""

import json
import math
from typing import Any


def without_nan(value: Any) -> Any:
    """Nested dicts and lists in which None replaces NaN and infinity."""
    if isinstance(value, dict):
        return {k: without_nan(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_text(value: Any) -> str:
    """Valid JSON of nested dicts and lists."""
    return json.dumps(without_nan(value), allow_nan=False)
