"""Downloads of crates by pages and REST: of a plan, and of another lab."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from tempfile import TemporaryFile
from typing import IO

from django.http import HttpRequest, StreamingHttpResponse

from evaweb.blinding.visibility import Visibility
from evaweb.plans.models import Plan
from evaweb.results.crates.export import write_crate
from evaweb.results.crates.imported import open_crate_file, require_visible_crate
from evaweb.results.crates.options import CrateOptions
from evaweb.results.models import ImportedCrate
from evaweb.results.ratings.result_visibility import require_visible_results
from evaweb.serving.downloads import download

MOST_PICTURES = 32_000_000  # [bytes] of images in a report that is downloaded; commands have no such limit
MOST_VIDEOS = 500_000_000  # [bytes]; anybody who sees the results may ask for them
_BLOCK = 1 << 18


def crate_response(
    request: HttpRequest, user: object, plan: Plan, options: CrateOptions
) -> StreamingHttpResponse:
    """Return the crate of a plan as a download. Raises: EvaError; NotAllowed if the user may not see the results."""
    require_visible_results(plan, user)
    with ExitStack() as stack:
        file = stack.enter_context(TemporaryFile())
        write_crate(plan, options, file, most_pictures=MOST_PICTURES, most_videos=MOST_VIDEOS)
        file.seek(0)
        stack.pop_all()  # closed when it has been sent
    return download(request, _blocks(file), f"{plan.name}-v{plan.version}-crate.zip", "application/zip")


def imported_crate_response(
    request: HttpRequest, crate: ImportedCrate, visibility: Visibility
) -> StreamingHttpResponse:
    """Return an imported crate as it came, as a download. Raises: NotAllowed if it is sealed for the user; NotFound."""
    require_visible_crate(crate, visibility)
    file = open_crate_file(crate)
    return download(request, _blocks(file), f"crate-{crate.sha256[:12]}.zip", "application/zip")


def _blocks(file: IO[bytes]) -> Iterator[bytes]:
    with file:
        while block := file.read(_BLOCK):
            yield block
