"""Side files of an episode for its dataset: verdicts and annotations, a line each."""

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
    """Verdicts and annotations of the episode, by kind of side file."""
    lines = REVIEWS.read(uuid, log.warning)
    return {
        "reviews": [line for line in lines if isinstance(line, ReviewLine)],
        "annotations": segments_of(lines),
    }


@register_sidecar_writer
def write_review_sidecars(uuid: UUID, folder: Path) -> Mapping[str, Path]:
    """The files of that, in `folder`; none of a kind of which nothing is said."""
    made = {}
    for kind, said in review_lines(uuid).items():
        if said:
            made[kind] = folder / f"{kind}.jsonl"
            lines = (json.dumps(line.model_dump(mode="json", exclude={"kind"})) + "\n" for line in said)
            made[kind].write_text("".join(lines), "utf-8")
    return made
