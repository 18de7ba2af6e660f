"""Sidecar files of an episode in its dataset: reviews and annotations, one per line."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from uuid import UUID

from evaweb.episodes.dataset_sidecars import register_sidecar_writer
from evaweb.reviews.record import REVIEWS, AnyReview, ReviewLine, segments_of

log = logging.getLogger(__name__)


def review_lines(uuid: UUID) -> dict[str, Sequence[AnyReview]]:
    """Return reviews and annotations of the episode, by kind of sidecar file."""
    lines = REVIEWS.read(uuid, log.warning)
    return {
        "reviews": [line for line in lines if isinstance(line, ReviewLine)],
        "annotations": segments_of(lines),
    }


@register_sidecar_writer
def write_review_sidecars(uuid: UUID, folder: Path) -> Mapping[str, Path]:
    """Write the sidecar files to `folder` and return them by kind.

    A kind of which the episode has no reviews gets no file.
    """
    paths = {}
    for kind, reviews in review_lines(uuid).items():
        if reviews:
            paths[kind] = folder / f"{kind}.jsonl"
            lines = (json.dumps(line.model_dump(mode="json", exclude={"kind"})) + "\n" for line in reviews)
            paths[kind].write_text("".join(lines), "utf-8")
    return paths
