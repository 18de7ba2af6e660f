"""Validation of query parameters and of request bodies.

Unknown parameters are refused, because a misspelt filter would have no effect. The length of a body is checked, and the
body parsed, only after its sender is known. Texts that the database or the wire cannot represent are refused before a
view is called.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any

from django.http import HttpRequest
from ninja.parser import Parser

from evaweb.accounts.roles import require_role
from evaweb.core.errors import EvaError
from evaweb.serving.body_limits import body_limit_for
from evaweb.serving.error_pages import is_text
from evaweb.stations.commands import STOPPING
from runtime.core import bounded_documents as bounded
from runtime.core.sentences import Pattern
from runtime.ipc import estop_requests as pressing

_UNKNOWN_PARAMETER = Pattern(
    "api.questions.unknown_parameter",
    "{unknown:.200}: unknown parameter; allowed: {known}",
)
_BODY_TOO_LONG = Pattern(
    "api.questions.body_too_long",
    "the body has {count} bytes; allowed here: at most {largest}",
)
_NO_TEXT = Pattern(
    "api.questions.no_text",
    "{place} = {text!r:.80}: allowed: text without NUL and half characters",
)

View = Callable[..., Any]


class UnknownParameter(EvaError):
    """The query has a parameter that the address does not support."""

    status = 422


def reject_unknown_parameters(view: View) -> View:
    """Wrap the view of an operation such that unknown query parameters are refused."""

    @wraps(view)
    def asked(request: HttpRequest, *args: Any, **named: Any) -> Any:
        if request.method == "GET":
            _check(set(request.GET), _parameters(view))
        return view(request, *args, **named)

    return asked


def _parameters(view: Any) -> list[str]:
    """Return the names of all query parameters in the order of the documentation."""
    models = [model for model in view._ninja_operation.models if model.__ninja_param_source__ == "query"]
    return [name for model in models for name in model.__ninja_flatten_map__]


def _check(names: set[str], allowed: list[str]) -> None:
    unknown = ", ".join(sorted(names - set(allowed)))
    if unknown:
        raise UnknownParameter(_UNKNOWN_PARAMETER(unknown=unknown, known=", ".join(allowed) or "none"))


class TooLong(EvaError):
    """The body is longer than allowed at this address."""

    status = 413


class BoundedParser(Parser):
    """Parser that reads a body when its sender is known; the body of an e-stop press may be anything."""

    def parse_body(self, request: Any) -> Any:
        """Return the JSON body, whose texts can be stored.

        Raises:
            NotAllowed: If the user's role does not allow the request.
            TooLong: If the body is too long.
            bounded.UnreadableDocument: If it is not valid JSON, or too complex.
            EvaError: If a text cannot be stored.
        """
        pressed = request.path.endswith("/estop")
        if not (request.path.endswith("/commands") and pressing.parse_json_press(request.body, "kind")):
            require_role(request.auth, body_limit_for(request.path).role)
        try:
            body = _read(request)
            return _without_unknown(body) if request.path.endswith("/commands") else body
        except (EvaError, bounded.UnreadableDocument):
            if pressed:
                return {}
            raise


def _without_unknown(body: Any) -> Any:
    """Return the body of a request; the unknown fields are removed if the request is a stop.

    Unknown fields must not prevent a stop.
    """
    from evaweb.api.stations import CommandIn  # imported here: stations is validated by this module

    if not _stops(body):
        return body
    return {name: value for name, value in body.items() if name in CommandIn.model_fields}


def _stops(body: Any) -> bool:
    kind = body.get("kind") if isinstance(body, dict) else None
    return isinstance(kind, str) and kind in STOPPING


def _read(request: HttpRequest) -> Any:
    post = body_limit_for(request.path)
    if len(request.body) > post.largest:
        raise TooLong(_BODY_TOO_LONG(count=len(request.body), largest=post.largest))
    body = bounded.parse_json(request.body, "the body", most=post.values)
    if b"\\u" in request.body and not _stops(body):
        for place, text in _iter_strings(body):
            if not is_text(text):
                raise EvaError(_NO_TEXT(place=place or "body", text=text))
    return body


def _iter_strings(item: Any, place: str = "") -> Iterator[tuple[str, str]]:
    """Yield every string, field names included, with its place."""
    if isinstance(item, str):
        yield place, item
    elif isinstance(item, list):
        for value in item:
            yield from _iter_strings(value, place)
    elif isinstance(item, dict):
        for name, value in item.items():
            yield place, name
            yield from _iter_strings(value, f"{place}.{name}".strip("."))
