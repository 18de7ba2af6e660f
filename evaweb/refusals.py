"""Turns an EvaError that a page raises into its HTTP answer; evaweb.api does the same for REST."""

from __future__ import annotations

from django.http import HttpRequest, HttpResponse, JsonResponse
from django.shortcuts import render
from django.utils.deprecation import MiddlewareMixin

from evaweb.errors import EvaError


class RefusalMiddleware(MiddlewareMixin):
    """A page with the sentence for a browser that navigates, {"error": sentence} for everything else."""

    def process_exception(self, request: HttpRequest, exception: Exception) -> HttpResponse | None:
        if not isinstance(exception, EvaError):
            return None
        if "text/html" in request.headers.get("Accept", ""):
            context = {"sentence": str(exception), "status": exception.status}
            return render(request, "refused.html", context, status=exception.status)
        return JsonResponse({"error": str(exception)}, status=exception.status)
