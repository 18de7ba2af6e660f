"""Episodes of one dataset for a page: data of the dataset, and what the lab knows about them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from uuid import UUID

from evaweb.datasets.overview import open_cached
from evaweb.episodes.models import Episode
from evaweb.serving.lists import words_of
from runtime.datasets import layout
from runtime.datasets.card import result_of
from runtime.datasets.reader import Dataset
from runtime.recording.files import RecordingError

RESULTS = ("success", "partial", "fail", "unknown")
VERDICTS = ("pass", "fail", "unreviewed")


@dataclass(frozen=True, slots=True)
class DatasetRow:
    """Episode of a dataset; `recording` is the lab's row, if it was recorded here."""

    index: int
    length: int
    seconds: float
    task: str
    uuid: str = ""
    success: bool | None = None
    result: str = ""  # label by the operator; unlike `success` it can be partial
    outcome: str = ""
    station: str = ""
    recording: Episode | None = None

    @property
    def verdict(self) -> str:
        """Verdict of its review: "pass", "fail", or "" if undecided."""
        review = getattr(getattr(self.recording, "standing", None), "review", None)
        return str(review.verdict) if review else ""


def list_rows(
    name: str, *, words: str = "", success: str = "", result: str = "", verdict: str = ""
) -> list[DatasetRow]:
    """Return the episodes of a dataset whose task, uuid or station contain all `words`, filtered further.

    `success` is "yes", "no" or "unknown", `result` one of RESULTS, `verdict` one of VERDICTS; other values have no
    effect. Raises: RecordingError; EvaError for too many words.
    """
    sought = words_of(words.lower())
    dataset = open_cached(name)
    lines = recorded_lines(dataset)
    recordings = _known([str(line.get("uuid")) for line in lines.values()])
    rows = [_row(dataset, listed, lines.get(listed.index, {}), recordings) for listed in dataset.episodes]
    return [row for row in rows if _fits(row, sought, success, result, verdict)]


def recorded_lines(dataset: Dataset) -> dict[int, Mapping[str, Any]]:
    """Return what this program wrote about each episode of a dataset, by index of the episode.

    The result is {} for a dataset of another program.

    Raises: RecordingError if a line names no episode.
    """
    lines = layout.read_lines(dataset.root / layout.EVA_EPISODES)
    try:
        return {int(line["episode_index"]): line for line in lines}
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f"{dataset.root / layout.EVA_EPISODES} has a line of no episode: {error!r}"
        ) from error


def _known(uuids: Sequence[str]) -> dict[str, Episode]:
    """Return the rows of these episodes in the database, by uuid."""
    keys = []
    for uuid in uuids:
        try:
            keys.append(UUID(uuid))
        except ValueError:
            continue
    episodes: dict[str, Episode] = {}
    for first in range(0, len(keys), 500):  # limit of query parameters
        chosen = Episode.objects.select_related("trial", "standing__review__reviewer")
        episodes |= {str(row.uuid): row for row in chosen.filter(uuid__in=keys[first : first + 500])}
    return episodes


def _row(
    dataset: Dataset, listed: Any, line: Mapping[str, Any], recordings: Mapping[str, Episode]
) -> DatasetRow:
    uuid, success, outcome = str(line.get("uuid", "")), line.get("success"), line.get("outcome")
    return DatasetRow(
        index=listed.index,
        length=listed.length,
        seconds=listed.length / dataset.fps,
        task=", ".join(listed.tasks),
        uuid=uuid,
        success=success if isinstance(success, bool) else None,
        result=result_of(line),
        outcome=str(outcome.get("status", "")) if isinstance(outcome, Mapping) else "",
        station=str(line.get("station", "")),
        recording=recordings.get(uuid),
    )


def _fits(row: DatasetRow, sought: Sequence[str], success: str, result: str, verdict: str) -> bool:
    text = f"{row.task} {row.uuid} {row.station}".lower()
    success_of = {"yes": True, "no": False, "unknown": None}
    return (
        all(word in text for word in sought)
        and (success not in success_of or row.success is success_of[success])
        and (result not in RESULTS or (row.result or "unknown") == result)
        and (verdict not in VERDICTS or (row.verdict or "unreviewed") == verdict)
    )
