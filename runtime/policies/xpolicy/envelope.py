"""Envelopes of the XPolicyLab protocol: one map per message, whose reply repeats its id.

A server answers a message that it cannot read with silence.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal

from runtime.core.errors import ServerReportedError, WrongProtocolError
from runtime.policies.websocket_link import error_headline

Kind = Literal["hello", "reset", "infer", "trial_end", "heartbeat", "close"]
_REPLIES: Mapping[Kind, str] = {
    "hello": "hello_ack",
    "reset": "reset_result",
    "infer": "infer_result",
    "trial_end": "trial_end_ack",
    "heartbeat": "heartbeat_ack",
}
_DETAILS = 400  # characters of an error's details that are shown


@dataclass(frozen=True, slots=True)
class Request:
    """Message to the server; `step` is the number of the inference in its trial."""

    kind: Kind
    evaluation: str
    payload: Mapping[str, Any]
    trial: str | None = None
    step: int = 0
    number: str = field(default_factory=lambda: str(uuid.uuid4()))  # id of the message
    sent_at: str = field(default_factory=lambda: datetime.now(UTC).isoformat())

    def to_dict(self) -> dict[str, Any]:
        """Return the map that is sent."""
        return {
            "message_type": self.kind,
            "evaluation_id": self.evaluation,
            "action_case_id": None,
            "trial_id": self.trial,
            "repeat_index": None,
            "step": self.step,
            "sent_at": self.sent_at,
            "message_id": self.number,
            "payload": dict(self.payload),
        }

    def is_answered_by(self, message: Any) -> bool:
        """Return whether a message is the reply to this request; False for the reply to another.

        Raises WrongProtocolError if it is no reply at all.
        """
        if not isinstance(message, Mapping) or not isinstance(message.get("message_id"), str):
            what = (
                f"a map of {_keys(message)}"
                if isinstance(message, Mapping)
                else f"a {type(message).__name__}"
            )
            raise WrongProtocolError(
                f"the server sent {what}; expected a map with message_type, message_id and payload: it is no "
                "XPolicyLab server; correct policy.kind or policy.url"
            )
        return bool(message["message_id"] == self.number)

    def read(self, reply: Mapping[str, Any]) -> dict[str, Any]:
        """Return the payload of the reply to this request.

        Raises ServerReportedError with the code of the server's error, WrongProtocolError for a reply of another type.
        """
        kind, payload = reply.get("message_type"), reply.get("payload")
        if not isinstance(kind, str):  # an array, too, which cannot be compared
            raise WrongProtocolError(
                f"the answer to {self.kind} has a message_type that is a {type(kind).__name__}; expected a string"
            )
        if not isinstance(payload, dict):
            raise WrongProtocolError(
                f"the answer to {self.kind} has a payload that is a {type(payload).__name__}; expected a map"
            )
        if kind == "error":
            raise ServerReportedError(
                f"the policy server reports an error in {self.kind}: {_error_text(payload)}"
            )
        if kind != _REPLIES[self.kind]:
            raise WrongProtocolError(
                f"the answer to {self.kind} has message_type {kind!r}; expected {_REPLIES[self.kind]!r}"
            )
        if self.kind != "infer" and payload.get("ok") is not True:
            raise ServerReportedError(
                f"the policy server answered {self.kind} with ok = {payload.get('ok')!r}; expected true"
            )
        return payload


def _error_text(payload: Mapping[str, Any]) -> str:
    message, details = payload.get("message"), payload.get("details")
    text = error_headline("nothing more" if message is None else str(message))
    more = f" ({str(details)[:_DETAILS]})" if isinstance(details, dict | str) and details else ""
    return f"{payload.get('code')}: {text}{more}"


def _keys(message: Mapping[Any, Any]) -> str:
    return ", ".join(map(str, message))[:80] or "nothing"
