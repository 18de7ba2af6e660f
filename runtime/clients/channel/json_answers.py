"""Answers of the channel as JSON that every parser accepts: non-finite numbers become null."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from runtime.clients.channel.message import Message
from runtime.clients.channel.outcomes import Outcome


def dumps(content: Mapping[str, Any]) -> bytes:
    """Encode the map as one frame of JSON in ASCII."""
    return json.dumps(to_builtin(content), allow_nan=False).encode()


def to_builtin(value: Any) -> Any:
    """Convert a value to JSON's own types: NaN and infinity to None, arrays to lists, other types to text."""
    if isinstance(value, Mapping):
        return {str(key): to_builtin(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [to_builtin(part) for part in value]
    if isinstance(value, np.ndarray | np.generic):
        return to_builtin(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def command_answer(
    message: Message, outcome: Outcome, data: Mapping[str, Any], state: str | None
) -> dict[str, Any]:
    """Build the answer to a command; `state`: the station's state after it, None if unknown."""
    result = {"id": outcome.id, "result": outcome.result}
    if outcome.result in ("refused", "failed", "unknown"):
        return {"ok": False, "error": outcome.reason, **message.echo, **result}
    return {
        "ok": True,
        **message.echo,
        **result,
        "reason": outcome.reason,
        "state": state,
        "data": dict(data),
    }


def error_answer(why: str) -> dict[str, Any]:
    """Build the answer to a message that is not a command."""
    return {"ok": False, "error": why}
