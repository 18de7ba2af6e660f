"""Import of episodes recorded elsewhere into the lab, for checks, reviews and annotations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

from evaweb.core.errors import EvaError
from evaweb.datasets.dataset_orders import full_name
from evaweb.datasets.overview import folder_named
from evaweb.episodes import services
from evaweb.episodes.dataset_membership import sync_memberships
from evaweb.episodes.folders import data_dir, datasets_dir, episodes_dir
from runtime.core.sentences import Pattern
from runtime.datasets.episode_uuids import copy_with_uuids
from runtime.datasets.importing import import_episode, resolve_source_robot
from runtime.datasets.reader import open_dataset

_ALLOWED_NAME_DATASETS_NAME_WHAT = Pattern(
    "datasets.importing.allowed_name_datasets_name_what",
    "to = {to!r:.120}; allowed: a name, or datasets/NAME: what is reviewed lies there",
)


@dataclass(frozen=True, slots=True)
class ImportResult:
    """Result of an import: dataset name, its episodes in order, and the number of new ones."""

    dataset: str
    episodes: tuple[UUID, ...]
    made: int
    problems: tuple[str, ...]  # other datasets that could not be read


def import_dataset(
    dataset: Path,
    *,
    to: str = "",
    state: str = "",
    robot: str = "",
    rename: Mapping[str, str] | None = None,
    reencode: bool = False,
    tell: Callable[[str], None] = lambda _: None,
) -> ImportResult:
    """Import a LeRobot dataset of any version as a dataset of this lab.

    Episodes imported before are unchanged, so that an interrupted import can be continued.

    Args:
        dataset: Folder of the dataset to import.
        to: Name of the new dataset, "" for that of the folder.
        state: Column of the measured joints, "" for the first column with a usual name.
        robot: Robot to which the values belong, "" if unknown.
        rename: New names of features.
        reencode: Allow images to be encoded anew if they cannot be copied.
        tell: Receives progress messages.

    Raises:
        RecordingError: The dataset cannot be imported.
    """
    if not rename:
        resolve_source_robot(open_dataset(dataset), state, robot)  # fails before anything is copied
    target = _target(dataset, to)
    if target.resolve() != dataset.resolve():
        tell(f"{dataset} is copied to {target}")
    copied = copy_with_uuids(dataset, target, rename=rename, reencode=reencode, tell=tell)
    source_robot = resolve_source_robot(copied, state, robot)
    uuids, created = [], 0
    for entry in copied.episodes:
        tell(f"episode {entry.index + 1} of {len(copied.episodes)}")
        uuid, new = import_episode(copied, entry.index, episodes_dir(), source_robot)
        services.sync_episode(uuid=UUID(uuid))
        uuids.append(UUID(uuid))
        created += new
    problems = sync_memberships()
    return ImportResult(target.relative_to(data_dir()).as_posix(), tuple(uuids), created, tuple(problems))


def _target(dataset: Path, to: str) -> Path:
    """Return the folder below datasets/ called `to`; without `to`, the dataset's own folder if it is there already.

    Raises: EvaError if `to` is not a plain name.
    """
    source, root = dataset.resolve(), datasets_dir().resolve()
    if not to and source.parent == root:
        return datasets_dir() / source.name
    folder = folder_named(full_name(to) if to else f"datasets/{source.name}")
    if folder.parent != datasets_dir():
        raise EvaError(_ALLOWED_NAME_DATASETS_NAME_WHAT(to=to))
    return folder
