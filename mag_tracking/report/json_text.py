"""JSON in which null replaces NaN and infinity, which JSON does not permit."""

import json
import math
from typing import Any


def without_nan(value: Any) -> Any:
    """Replace NaN and infinity by None in a copy of nested dicts and lists; tuples become lists."""
    if isinstance(value, dict):
        return {k: without_nan(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_text(value: Any) -> str:
    """Serialise nested dicts and lists as JSON, with null for NaN and infinity."""
    return json.dumps(without_nan(value), allow_nan=False)
