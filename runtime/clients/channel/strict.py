"""JSON that every reader takes: what is no number there is null."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np


def dumps(content: Mapping[str, Any]) -> bytes:
    """The map as one frame of JSON in ASCII."""
    return json.dumps(to_builtin(content), allow_nan=False).encode()


def to_builtin(value: Any) -> Any:
    """The value in JSON's own types: NaN and infinity are None, arrays lists, what is foreign its text."""
    if isinstance(value, Mapping):
        return {str(key): to_builtin(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [to_builtin(part) for part in value]
    if isinstance(value, np.ndarray | np.generic):
        return to_builtin(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
