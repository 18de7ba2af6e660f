"""Conversion of exceptions on pages to HTTP responses; evaweb.api does the same for REST.

Failures before and after a view are converted here too. Programs get JSON.
"""

from __future__ import annotations

import logging
import re
import sys
from typing import Any

from django.contrib.auth.middleware import LoginRequiredMiddleware
from django.db import Error
from django.http import HttpRequest, HttpResponse, JsonResponse
from django.http.response import HttpResponseBase
from django.shortcuts import render
from django.utils.deprecation import MiddlewareMixin
from django.views import defaults

from evaweb.core.errors import EvaError, refusal
from evaweb.core.storage_errors import storage_error_response
from evaweb.core.write_conflicts import TAKEN, is_duplicate
from runtime.core.sentences import Pattern, fixed

log = logging.getLogger(__name__)
_NO_TEXT = re.compile("[\x00\ud800-\udfff]")
_NUL_IN_ADDRESS = fixed("web.nul_in_address", "there is a NUL in the address")
_NUL_IN_WHAT_WAS_SENT = fixed("web.nul_in_what_was_sent", "there is a NUL in what was sent; allowed: text")
_NOWHERE = Pattern(
    "web.nowhere",
    "{path} does not exist; docs/openapi.json and /api/v1/openapi.json list the addresses",
)
_NO_METHOD = Pattern("web.no_method", "{method:.20} is not possible at this address; allowed: {allowed}")
_DATABASE_AWAY = fixed("web.database_away", "the database is busy or gone: try again")
_FAILED = fixed("web.failed", "this failed; see the log of the web")


class LoginMiddleware(LoginRequiredMiddleware):
    """Login middleware that does not look up the user for views without login.

    Django's own middleware queries the user for all views.
    """

    def process_view(self, request: HttpRequest, view: Any, *given: Any) -> HttpResponseBase | None:
        if not getattr(view, "login_required", True):
            return None
        response: HttpResponseBase | None = super().process_view(request, view, *given)
        return response


class RefusalMiddleware(MiddlewareMixin):
    """Middleware that gives every error response a message.

    A browser that navigates gets a page, any other client JSON (`errors.refusal`).
    """

    def process_view(self, request: HttpRequest, *given: Any) -> HttpResponse | None:
        # REST parses its body itself, checked by evaweb.api.request_validation.
        fields = [request.GET] if _of_programs(request) else [request.GET, request.POST]
        texts = (text for query in fields for name, values in query.lists() for text in (name, *values))
        if not is_text(request.path):
            return error_response(request, _NUL_IN_ADDRESS, 404, "refused.html")
        if not all(map(is_text, texts)):
            return error_response(request, _NUL_IN_WHAT_WAS_SENT, 400, "refused.html")
        return None

    def process_response(self, request: HttpRequest, response: HttpResponseBase) -> HttpResponseBase:
        """Return the response, or an error response with a message that replaces it.

        An error response that is not JSON is replaced if the request was to REST or the status is 405 (method not
        allowed).
        """
        status = response.status_code
        spoken = response.headers.get("Content-Type", "").startswith("application/json")
        if status < 400 or spoken or not (_of_programs(request) or status == 405):
            return response
        page = error_response(request, _sentence_of(request, response), status, "refused.html")
        if "Allow" in response.headers:
            page["Allow"] = response["Allow"]
        return page

    def process_exception(self, request: HttpRequest, exception: Exception) -> HttpResponse | None:
        if _is_no_number(exception):
            log.warning("%a was refused", request.path, exc_info=exception)
            return error_response(request, f"{exception!s:.120}", 400, "refused.html")
        if is_duplicate(exception):
            log.warning("%a was refused: %s", request.path, exception)
            return error_response(request, TAKEN, 409, "refused.html")
        if not isinstance(exception, EvaError):
            return None
        return retrying(error_response(request, str(exception), exception.status, "refused.html"), exception)


def retrying(answer: HttpResponse, fault: EvaError) -> HttpResponse:
    """Return `answer` with a Retry-After header if `fault` has a delay."""
    if fault.retry_after_s is not None:
        answer["Retry-After"] = str(fault.retry_after_s)
    return answer


def unknown_address_sentence(path: str) -> str:
    """Return the message for an unknown REST path."""
    return _NOWHERE(path=path)


def _sentence_of(request: HttpRequest, response: HttpResponseBase) -> str:
    if response.status_code == 404:
        return unknown_address_sentence(request.path)
    if response.status_code == 405:
        allowed = response.headers.get("Allow") or "nothing"
        return _NO_METHOD(method=request.method, allowed=allowed)
    return response.reason_phrase


def _is_no_number(exception: Exception) -> bool:
    """Return True if forms have passed a number that the database or Python cannot represent."""
    text = str(exception)
    none = "expected a number but got" in text or text.startswith("Exceeds the limit")
    return isinstance(exception, OverflowError) or none


def is_text(given: str) -> bool:
    """Return True if every database and protocol accepts the text: no NUL, no lone surrogate."""
    return _NO_TEXT.search(given) is None


def error_response(request: HttpRequest, sentence: str, status: int, template: str) -> HttpResponse:
    """Return `template` with the message for a browser that navigates, JSON (`errors.refusal`) otherwise."""
    if "text/html" in request.headers.get("Accept", "") and not _of_programs(request):
        return render(request, template, {"sentence": sentence, "status": status}, status=status)
    return JsonResponse(refusal(sentence), status=status)


def bad_request(request: HttpRequest, exception: Exception) -> HttpResponse:
    """Respond to a bad request, such as a host that is not allowed (Django's handler400)."""
    return error_response(request, f"{exception!s:.300}" or "bad request", 400, "unavailable.html")


def server_error(request: HttpRequest) -> HttpResponse:
    """Respond to an exception (Django's handler500).

    Storage faults have a message; any other exception is reported as an internal error.
    """
    fault = sys.exc_info()[1]
    refused = storage_error_response(fault)
    if refused is not None:
        return error_response(request, *refused, "unavailable.html")
    if not _of_programs(request):
        return defaults.server_error(request)
    if isinstance(fault, Error):
        return JsonResponse(refusal(_DATABASE_AWAY), status=503)
    return JsonResponse(refusal(_FAILED), status=500)


def _of_programs(request: HttpRequest) -> bool:
    return request.path.startswith("/api/")
