"""Catalogues of the languages in which sentences are shown."""

from __future__ import annotations

import hashlib

from django.http import HttpRequest, HttpResponse, JsonResponse
from django.utils.cache import get_conditional_response

from evaweb.core.errors import NotFound
from evaweb.core.languages import language, offered
from runtime.core.sentences import Pattern

_NO_LANGUAGE = Pattern("console.languages.none", "language {code!r:.20} is not there; there are: {known}")


def catalogue(request: HttpRequest, code: str) -> HttpResponse:
    """Return the patterns of a language by id, as static/site/sentences.js reads them."""
    spoken = language(code)
    if spoken is None:
        codes = ", ".join(entry.code for entry in offered()) or "none but English"
        raise NotFound(_NO_LANGUAGE(code=code, known=codes))
    answer = JsonResponse({"name": spoken.name, "sentences": dict(spoken.patterns)})
    answer["Cache-Control"] = "no-cache"  # every page requests it; it is sent only if it has changed
    answer["ETag"] = f'"{hashlib.sha256(answer.content).hexdigest()[:32]}"'
    return get_conditional_response(request, etag=answer["ETag"], response=answer) or answer
