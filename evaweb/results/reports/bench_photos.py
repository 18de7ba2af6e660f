"""Images of the bench before each trial of a plan, for the plan's report.

For each trial and camera, the report contains the image and the reference with which the image was compared then.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from evaweb.core.errors import NotFound
from evaweb.plans import image_store
from evaweb.plans.models import Achieved, Plan

COLUMNS = ("trial", "camera", "picture", "reference", "match", "regions", "override", "by", "at")
_FIELDS = (
    "trial_id",
    "camera",
    "picture",
    "reference__picture",
    "match",
    "regions",
    "override",
    "by__username",
    "at",
)


def layout_rows(plan: Plan) -> Iterator[list[dict[str, Any]]]:
    """Yield pages of rows; there is one row for each camera of each attempt."""
    rows = Achieved.objects.filter(trial__evaluation=plan.evaluation_id).order_by("trial_id", "pk")
    yield [dict(zip(COLUMNS, row, strict=True)) for row in rows.values_list(*_FIELDS)]


def with_json_regions(pages: Iterable[list[dict[str, Any]]]) -> Iterator[list[dict[str, Any]]]:
    """Yield the pages with each row's regions as JSON text, "" if it has none."""
    for rows in pages:
        yield [{**row, "regions": json.dumps(row["regions"]) if row["regions"] else ""} for row in rows]


def write_pictures(plan: Plan, folder: Path, most: int | None) -> int:
    """Write each image once, named by its SHA-256, up to `most` bytes; return the number of omitted or lost images."""
    rows = [row for page in layout_rows(plan) for row in page]
    names = dict.fromkeys(row[which] for row in rows for which in ("picture", "reference") if row[which])
    left, written = 0, 0
    for name in names:
        try:
            jpeg = image_store.load_image(name)
        except NotFound:
            left += 1
            continue
        if most is not None and written + len(jpeg) > most:
            left += 1
            continue
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.jpg").write_bytes(jpeg)
        written += len(jpeg)
    return left
