"""REST interface under /api/v1: routers, authentication, and the only place that converts errors to answers."""

from __future__ import annotations

import json
import logging
from typing import Any

from django.conf import settings
from django.db import IntegrityError, InterfaceError, InternalError, OperationalError
from django.http import Http404, HttpRequest, HttpResponse
from ninja import NinjaAPI
from ninja.errors import AuthenticationError, HttpError, ValidationError, ValidationErrorContext

from evaweb.api import (
    accounts,
    checkpoints,
    crates,
    datasets,
    episodes,
    failures,
    find,
    jobs,
    plans,
    preflights,
    results,
    reviews,
    scenes,
    sessions,
    stations,
    statistics,
    subsets,
    templates,
    trials,
)
from evaweb.api.auth import NOT_LOGGED_IN, Bearer, Session
from evaweb.api.request_validation import BoundedParser, reject_unknown_parameters
from evaweb.api.responses import describe_errors
from evaweb.core.errors import EvaError, refusal
from evaweb.core.storage_errors import storage_error_response
from evaweb.core.write_conflicts import TAKEN, is_duplicate
from evaweb.serving.error_pages import retrying
from runtime.core import bounded_documents as bounded

log = logging.getLogger(__name__)


class _Api(NinjaAPI):
    """NinjaAPI whose validation errors include the given value; Ninja's own only state what is allowed."""

    def validation_error_from_error_contexts(
        self, error_contexts: list[ValidationErrorContext]
    ) -> ValidationError:
        """Return every validation error with its place and the given value."""
        return ValidationError(
            [
                {key: error[key] for key in ("loc", "type", "msg", "input")}
                for context in error_contexts
                for error in context.pydantic_validation_error.errors(include_url=False)
            ]
        )


api = _Api(
    parser=BoundedParser(),
    title="EVA Web",
    version="1",
    urls_namespace="api",
    description="Every entity and every statistic of the lab. Log in, or send `Authorization: Bearer TOKEN`.",
    auth=[Bearer(), Session()],
    openapi_url=None,  # served below, to logged-in users
    docs_url=None,  # its pages would fetch external scripts
)
api.add_decorator(reject_unknown_parameters)
api.add_router("", accounts.router)
api.add_router("", plans.router)
api.add_router("/stations", stations.router)
api.add_router("/trials", trials.router)
api.add_router("/statistics", statistics.router)
api.add_router("/episodes", episodes.router)
api.add_router("/datasets", datasets.router)
api.add_router("/subsets", subsets.router)
api.add_router("", reviews.router)
api.add_router("/scenes", scenes.router)
api.add_router("/failures", failures.router)
api.add_router("/checkpoints", checkpoints.router)
api.add_router("/templates", templates.router)
api.add_router("/preflights", preflights.router)
api.add_router("", sessions.router)
api.add_router("", results.router)
api.add_router("/crates", crates.router)
api.add_router("/jobs", jobs.router)
api.add_router("/find", find.router)


@api.get("/openapi.json", include_in_schema=False, url_name="openapi")
def openapi(request: HttpRequest) -> Any:
    """Return the OpenAPI document of this interface."""
    return api.get_openapi_schema()


@api.exception_handler(EvaError)
def _refused(request: HttpRequest, fault: EvaError) -> HttpResponse:
    return retrying(_failure(request, str(fault), fault.status), fault)


@api.exception_handler(AuthenticationError)
def _not_logged_in(request: HttpRequest, fault: AuthenticationError) -> HttpResponse:
    return _failure(request, NOT_LOGGED_IN, 401)


@api.exception_handler(ValidationError)
def _malformed(request: HttpRequest, fault: ValidationError) -> HttpResponse:
    return _failure(request, describe_errors(fault.errors), 422)


@api.exception_handler(HttpError)
def _http(request: HttpRequest, fault: HttpError) -> HttpResponse:
    cause = fault.__cause__  # the reason why the body was not read; Ninja's own message lacks it
    if isinstance(cause, Exception) and not isinstance(cause, bounded.UnreadableDocument):
        return api.on_exception(request, cause)
    return _failure(request, str(cause or fault), fault.status_code)


@api.exception_handler(Http404)
def _nowhere(request: HttpRequest, fault: Http404) -> HttpResponse:
    return _failure(request, str(fault) or "there is nothing here", 404)


@api.exception_handler(OperationalError)
@api.exception_handler(InterfaceError)
@api.exception_handler(InternalError)
@api.exception_handler(OSError)
def _storage(request: HttpRequest, fault: Exception) -> HttpResponse:
    refused = storage_error_response(fault)
    if refused is None:
        raise fault
    log.error("%s %s was not taken: %s", request.method, request.path, fault)
    return _failure(request, *refused)


@api.exception_handler(IntegrityError)
def _taken(request: HttpRequest, fault: IntegrityError) -> HttpResponse:
    if not is_duplicate(fault):
        raise fault
    log.warning("%s %s was refused: %s", request.method, request.path, fault)
    return _failure(request, TAKEN, 409)


def _failure(request: HttpRequest, sentence: str, status: int) -> HttpResponse:
    return api.create_response(request, refusal(sentence), status=status)


def openapi_snapshot() -> str:
    """Return the document sorted and indented for readable differences, with a neutral name of the session cookie."""
    text = json.dumps(api.get_openapi_schema(path_prefix="/api/v1/"), indent=1, sort_keys=True) + "\n"
    return text.replace(settings.SESSION_COOKIE_NAME, "eva_session_LAB")
