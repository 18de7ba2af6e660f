"""What a question may ask: a parameter nobody knows is refused, because a filter that is misspelt filters nothing."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from django.http import HttpRequest

from evaweb.errors import EvaError

View = Callable[..., Any]


class UnknownParameter(EvaError):
    """The query has a parameter that this address does not have."""

    status = 422


def only_known(view: View) -> View:
    """Wrap the view of an operation: of a reading one every parameter of the query has to be known."""

    @wraps(view)
    def asked(request: HttpRequest, *args: Any, **named: Any) -> Any:
        if request.method == "GET":
            _check(set(request.GET), _parameters(view))
        return view(request, *args, **named)

    return asked


def _parameters(view: Any) -> list[str]:
    """The names of all parameters of the query, in the order of the documentation."""
    models = [model for model in view._ninja_operation.models if model.__ninja_param_source__ == "query"]
    return [name for model in models for name in model.__ninja_flatten_map__]


def _check(given: set[str], known: list[str]) -> None:
    unknown = ", ".join(sorted(given - set(known)))
    if unknown:
        raise UnknownParameter(f"{unknown:.200}: unknown parameter; allowed: {', '.join(known) or 'none'}")
