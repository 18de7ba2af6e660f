"""Exceptions with a message for users; evaweb.api and evaweb.serving.error_pages convert them to HTTP responses."""

from __future__ import annotations

from typing import Any

from runtime.core.sentences import Sentence, identity, plain


class EvaError(Exception):
    """Error for a request that cannot be fulfilled.

    The message names the offender, the given value and the allowed ones. If it is a `Sentence`, str() of the exception
    returns that Sentence.
    """

    status = 400
    retry_after_s: int | None = None  # delay before a retry [s]


class NotAllowed(EvaError):
    """Error if the user lacks the right to do this."""

    status = 403


class NotFound(EvaError):
    """Error if the named object does not exist."""

    status = 404


class Conflict(EvaError):
    """Error if the request is impossible in the present state."""

    status = 409


class StationGone(EvaError):
    """Error if the station does not respond."""

    status = 503


def refusal(sentence: str) -> dict[str, Any]:
    """Return an error as JSON: its text and, for a `Sentence`, id and arguments from which pages translate it."""
    return {"error": plain(sentence)} | _identity(sentence)


def reasoned(reason: str) -> dict[str, Any]:
    """Return a reason as JSON, in the form of `refusal`."""
    return {"reason": plain(reason)} | _identity(reason)


def _identity(text: str) -> dict[str, Any]:
    return identity(text) if isinstance(text, Sentence) else {}
