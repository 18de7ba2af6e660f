"""Results of other labs, which were imported as RO-Crates and are read-only."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from django.http import HttpRequest
from ninja import Query, Router, Schema

from evaweb.api.responses import FAILURES, Page, Paging
from evaweb.blinding.visibility import visibility_for_request
from evaweb.results.crates import imported
from evaweb.results.crates.download import imported_crate_response
from evaweb.results.models import ImportedCrate

router = Router(tags=["results"])


class CrateOut(Schema):
    """An imported crate.

    `content` has its origin, plan, seal, number of trials and counts of each checkpoint. While it is `sealed` for the
    caller, because a plan that is blind for them has one of its checkpoints, it is null.
    """

    sha256: str
    size: int
    imported_by: str
    imported_at: datetime
    sealed: bool
    content: dict[str, Any] | None


def _row(crate: ImportedCrate, sealed: bool) -> dict[str, Any]:
    return {
        **{name: getattr(crate, name) for name in ("sha256", "size", "imported_at")},
        "imported_by": crate.imported_by.get_username(),
        "sealed": sealed,
        "content": None if sealed else crate.content,
    }


@router.get(
    "", response={200: Page[CrateOut], **FAILURES}, summary="Results of other labs", url_name="crates"
)
def crates(request: HttpRequest, paging: Query[Paging]) -> Any:
    """Return the imported crates, newest first; they enter no statistic of this lab."""
    found = imported.imported_crates()
    rows = list(found[paging.offset : paging.offset + paging.limit])
    hidden = imported.hidden_crates(rows, visibility_for_request(request))
    items = [_row(row, row.pk in hidden) for row in rows]
    return {"total": found.count(), "limit": paging.limit, "offset": paging.offset, "items": items}


@router.get(
    "/{digest}", response={200: CrateOut, **FAILURES}, summary="One of them", url_name="imported-crate"
)
def crate(request: HttpRequest, digest: str) -> Any:
    """Return an imported crate by the SHA-256 of its zip."""
    row = imported.imported_crate(digest)
    return _row(row, bool(imported.hidden_crates([row], visibility_for_request(request))))


@router.get(
    "/{digest}/file",
    response={200: None, **FAILURES},
    summary="Its zip",
    url_name="imported-crate-file",
)
def crate_file(request: HttpRequest, digest: str) -> Any:
    """Return the zip of an imported crate as it came."""
    return imported_crate_response(request, imported.imported_crate(digest), visibility_for_request(request))


@router.delete("/{digest}", response={200: None, **FAILURES}, summary="Remove it", url_name="imported-crate")
def remove(request: HttpRequest, digest: str) -> None:
    """Remove the file and the content of an imported crate. Requires an administrator."""
    user: Any = request.auth  # type: ignore[attr-defined]
    imported.remove_crate(user=user, crate=imported.imported_crate(digest))
