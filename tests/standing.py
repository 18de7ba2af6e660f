"""What a snapshot says of a session's state."""

from __future__ import annotations

from typing import Any

from runtime.ipc.session_state import SessionState


def state_flags(state: str) -> dict[str, Any]:
    """Its word, and what it means."""
    return {"state": state, "state_is": SessionState(state).meaning_dict()}
