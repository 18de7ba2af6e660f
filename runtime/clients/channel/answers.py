"""The answers of the channel: `ok`, what was said, and what came of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from runtime.clients.channel.message import Message
from runtime.clients.channel.outcomes import Outcome


def command_answer(
    message: Message, outcome: Outcome, data: Mapping[str, Any], state: str | None
) -> dict[str, Any]:
    """The answer to a command; `state` is that of the station after it, None where that is not known."""
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
    """The answer to what is no command."""
    return {"ok": False, "error": why}
