"""Pages of the results of other labs, which were imported as RO-Crates and are read-only."""

from __future__ import annotations

from typing import Any

from django.contrib import messages
from django.core.paginator import Paginator
from django.http import HttpRequest, HttpResponse
from django.http.response import HttpResponseBase
from django.shortcuts import redirect, render
from django.views.decorators.http import require_GET, require_POST

from evaweb.accounts.orcid import ADDRESS
from evaweb.accounts.roles import Role, role_of
from evaweb.blinding.visibility import visibility_for_request
from evaweb.core.errors import EvaError
from evaweb.results.crates import imported
from evaweb.results.crates.download import imported_crate_response
from evaweb.results.crates.limits import MOST_UPLOAD
from evaweb.results.crates.presentation import shown_crate
from runtime.core.sentences import fixed

_NO_FILE = fixed("results.crates.choose_a_file", "no file was sent: choose the zip of a crate")
_PER_PAGE = 50
_MOST_REMOVED = 200  # records of removed crates on the page


@require_GET
def crates(request: HttpRequest) -> HttpResponse:
    """Render the imported crates, newest first, and for administrators the form that imports one."""
    return _list_page(request)


@require_POST
def import_crate(request: HttpRequest) -> HttpResponse:
    """Import the crate that an administrator sends, and show it; or say what is wrong with it."""
    file, user = request.FILES.get("file"), request.user
    try:
        if file is None:
            raise EvaError(_NO_FILE)
        row = imported.import_crate(user=user, file=file, most=MOST_UPLOAD)
    except EvaError as fault:
        return _list_page(request, fault)
    return redirect("imported-crate", digest=row.sha256)


@require_GET
def crate(request: HttpRequest, digest: str) -> HttpResponse:
    """Render an imported crate: its origin and its results; while it is sealed, only that it exists."""
    row, visibility = imported.imported_crate(digest), visibility_for_request(request)
    hidden = bool(imported.hidden_crates([row], visibility))
    context = {
        "shown": shown_crate(row, hidden),
        "why": imported.sealed_crate_reason(visibility) if hidden else "",
        "orcid_address": ADDRESS,
        "may_remove": role_of(request.user) is Role.ADMIN,
        "here": "crates",
    }
    return render(request, "results/imported.html", context)


@require_GET
def crate_file(request: HttpRequest, digest: str) -> HttpResponseBase:
    """Return an imported crate as it came."""
    return imported_crate_response(request, imported.imported_crate(digest), visibility_for_request(request))


@require_POST
def remove_crate(request: HttpRequest, digest: str) -> HttpResponse:
    """Remove an imported crate; for administrators."""
    user: Any = request.user
    imported.remove_crate(user=user, crate=imported.imported_crate(digest))
    messages.success(request, f"crate {digest[:12]} removed")
    return redirect("crates")


def _list_page(request: HttpRequest, fault: EvaError | None = None) -> HttpResponse:
    page = Paginator(imported.imported_crates(), _PER_PAGE).get_page(request.GET.get("page"))
    rows = list(page)
    hidden = imported.hidden_crates(rows, visibility_for_request(request))
    administers = role_of(request.user) is Role.ADMIN
    context = {
        "crates": [shown_crate(row, row.pk in hidden) for row in rows],
        "page": None if fault else page,  # the address of a refused import has no further pages
        "removed": list(imported.removed_crates()[:_MOST_REMOVED]) if administers else [],
        "may_import": administers,
        "most": MOST_UPLOAD,
        "fault": fault,
        "here": "crates",
    }
    return render(request, "results/crates.html", context, status=fault.status if fault else 200)
