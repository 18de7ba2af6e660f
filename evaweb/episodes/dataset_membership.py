"""Dataset of each episode, as recorded in the datasets; copies of a dataset contain the same episodes."""

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
    """Entry of an episode in one dataset."""

    dataset: str  # relative to the data folder
    index: int
    copied: bool  # the dataset was made from other datasets
    success: bool | None
    at: datetime


def sync_memberships() -> list[str]:
    """Update the rows of episodes with the dataset that contains them, or with no dataset.

    If several datasets contain an episode, one to which it was published is preferred to copies. Among these, a dataset
    of scored episodes is preferred, and then the dataset that the row names already. Unreadable datasets are returned
    as messages, and rows that refer to them are unchanged.
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
            continue  # the unreadable dataset may still be the right one
        if (dataset, index) != (home.dataset, home.index):
            Episode.objects.filter(uuid=uuid).update(
                dataset=home.dataset, dataset_index=home.index, published_at=home.at
            )
        _publish_outdated(uuid, home.success)
    return problems


def primary_membership(places: Sequence[Membership], before: str) -> Membership | None:
    """Return the membership that counts, None if there is none; `before` is the dataset that counted until now.

    The order of preference is that of `sync_memberships`.
    """
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
    """Return the dataset folders; hidden ones are left out: they are drafts, or remains of a crash that a repair
    removes.
    """
    root = datasets_dir()
    folders = [path for path in root.iterdir() if path.is_dir()] if root.is_dir() else []
    return sorted(path for path in folders if not path.name.startswith("."))


def _name(folder: Path) -> str:
    return str(folder.relative_to(data_dir()))


def _places(folder: Path) -> list[tuple[UUID, Membership]]:
    """Return the lab's episodes in a dataset; episodes without a uuid, which come from elsewhere, are left out."""
    table = folder / EVA_EPISODES
    if not (folder / INFO).exists():
        return []
    read_info(folder)
    if not table.exists():
        return []
    lines: Sequence[Mapping[str, object]] = Catalog.read(folder).eva
    at = datetime.fromtimestamp(table.stat().st_mtime, UTC)
    places = []
    for line in lines:
        success = line.get("success")
        place = Membership(
            dataset=_name(folder),
            index=int(str(line["episode_index"])),
            copied=COPIED_FROM in line,
            success=success if isinstance(success, bool) else None,
            at=at,
        )
        places.append((UUID(str(line["uuid"])), place))
    return places


def _publish_outdated(uuid: UUID, success: bool | None) -> None:
    """Queue the publication of an episode scored after its publication; the original job may be lost."""
    newest = success_of(scores_file(uuid))
    if newest is not None and newest != success and journal_folder(uuid).is_dir():
        for episode in Episode.objects.filter(uuid=uuid):
            services.request_publish(episode=episode)
