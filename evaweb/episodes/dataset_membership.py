"""Which dataset each episode is in, as the datasets themselves say; copies of a dataset hold the same episodes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from uuid import UUID

from evaweb.episodes import services
from evaweb.episodes.folders import data_dir, datasets_dir, journal_folder, scores_file
from evaweb.episodes.models import Episode
from evaweb.episodes.publishing import success_of
from runtime.datasets.assemble import COPIED_FROM
from runtime.datasets.catalog import Catalog
from runtime.datasets.layout import EVA_EPISODES, INFO, read_info
from runtime.recording.files import RecordingError


@dataclass(frozen=True, slots=True)
class Membership:
    """Place of an episode in one dataset, and what that says of it."""

    dataset: str  # relative to the data folder
    index: int
    copied: bool  # the dataset was made from others
    success: bool | None
    at: datetime


def sync_memberships() -> list[str]:
    """Make the rows say in which dataset their episodes are, and in none where they are in none any more.

    Of several the one counts that it was published into, not a copy of that; then the one that knows its success, the
    one that counted before. What cannot be read is returned as sentences, and rows that are there stay as they are.
    """
    places: dict[UUID, list[Membership]] = defaultdict(list)
    problems, unread = [], set()
    for folder in _datasets():
        try:
            for uuid, place in _places(folder):
                places[uuid].append(place)
        except (RecordingError, KeyError, TypeError, ValueError) as error:
            problems.append(str(error) if isinstance(error, RecordingError) else f"{folder}: {error!r}")
            unread.add(_name(folder))
    rows = Episode.objects.values_list("uuid", "dataset", "dataset_index")
    for uuid, dataset, index in rows.iterator():
        home = primary_membership(places.get(uuid, ()), dataset)
        if home is None:
            if index is not None and dataset not in unread:
                Episode.objects.filter(uuid=uuid).update(dataset="", dataset_index=None, published_at=None)
            continue
        if dataset in unread and home.dataset != dataset:
            continue  # the one that counted may still be the one that counts
        if (dataset, index) != (home.dataset, home.index):
            Episode.objects.filter(uuid=uuid).update(
                dataset=home.dataset, dataset_index=home.index, published_at=home.at
            )
        _publish_outdated(uuid, home.success)
    return problems


def primary_membership(places: Sequence[Membership], before: str) -> Membership | None:
    """The place that counts; `before` is the dataset that counted until now."""
    return min(
        places,
        key=lambda place: (
            place.copied,
            place.dataset.endswith("-unscored"),
            place.dataset != before,
            place.dataset,
        ),
        default=None,
    )


def _datasets() -> list[Path]:
    """Folders of datasets; hidden ones are on their way, or were left by a crash: `repair` removes those."""
    root = datasets_dir()
    there = [path for path in root.iterdir() if path.is_dir()] if root.is_dir() else []
    return sorted(path for path in there if not path.name.startswith("."))


def _name(folder: Path) -> str:
    return str(folder.relative_to(data_dir()))


def _places(folder: Path) -> list[tuple[UUID, Membership]]:
    """The episodes of ours in a dataset; those of others have no uuid, and no row."""
    told = folder / EVA_EPISODES
    if not (folder / INFO).exists():
        return []
    read_info(folder)
    if not told.exists():
        return []
    lines: Sequence[Mapping[str, object]] = Catalog.read(folder).eva
    at = datetime.fromtimestamp(told.stat().st_mtime, UTC)
    found = []
    for line in lines:
        success = line.get("success")
        place = Membership(
            dataset=_name(folder),
            index=int(str(line["episode_index"])),
            copied=COPIED_FROM in line,
            success=success if isinstance(success, bool) else None,
            at=at,
        )
        found.append((UUID(str(line["uuid"])), place))
    return found


def _publish_outdated(uuid: UUID, success: bool | None) -> None:
    """Have an episode published again that was scored, or scored otherwise, after it was; its job is lost."""
    newest = success_of(scores_file(uuid))
    if newest is not None and newest != success and journal_folder(uuid).is_dir():
        for episode in Episode.objects.filter(uuid=uuid):
            services.request_publish(episode=episode)
