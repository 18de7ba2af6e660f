"""The one family of errors that a person may read; evaweb.api turns them into HTTP answers."""

from __future__ import annotations

from typing import Any

from runtime.core.sentences import Sentence, identity, plain


class EvaError(Exception):
    """Something asked for that cannot be done; the message says what, what was given and what is allowed.

    Where it is a `Sentence`, str() of the error is that one.
    """

    status = 400
    retry_after_s: int | None = None  # when to try again [s]


class NotAllowed(EvaError):
    """This user may not do this."""

    status = 403


class NotFound(EvaError):
    """The named thing does not exist."""

    status = 404


class Conflict(EvaError):
    """It cannot be done in the present state."""

    status = 409


class StationGone(EvaError):
    """The station does not answer."""

    status = 503


def refusal(sentence: str) -> dict[str, Any]:
    """A refusal as JSON: the sentence, and where it has them its id and arguments, for pages in other languages."""
    return {"error": plain(sentence)} | _identity(sentence)


def reasoned(reason: str) -> dict[str, Any]:
    """A reason as JSON, told as a refusal is."""
    return {"reason": plain(reason)} | _identity(reason)


def _identity(text: str) -> dict[str, Any]:
    return identity(text) if isinstance(text, Sentence) else {}
