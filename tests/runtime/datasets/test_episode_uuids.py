"""Episodes of others are told apart by all that they hold, and known again in whatever files they lie."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from runtime.core.errors import RecordingError
from runtime.datasets import episode_uuids, layout
from runtime.datasets.episode_uuids import content_uuid, copy_with_uuids, uuids_of
from runtime.datasets.operations import convert
from runtime.datasets.reader import open_dataset
from tests.runtime.datasets.foreign import Plan, write

PLAN = Plan(version="v2.1", lengths=(4, 5), images=("cam_side",), gop=2, b_frames=0)
ROWS = "data/chunk-000/episode_000001.parquet"
OF_NUMBERS = "a2f1b80e-f0b6-5aa8-8af3-89ab187f05e2"  # what version 1 gave
VIDEO = "videos/chunk-000/observation.images.{}/episode_000001.mp4"


def written(root: Path, plan: Plan = PLAN) -> Path:
    write(root, plan)
    return root


def with_column(root: Path, name: str, change: Callable[[pa.ChunkedArray], pa.Array]) -> None:
    table = pq.read_table(root / ROWS)
    place = table.column_names.index(name)
    pq.write_table(table.set_column(place, name, change(table[name])), root / ROWS)


def other_pictures(column: pa.ChunkedArray) -> pa.Array:
    rows = column.to_pylist()
    return pa.array([rows[0], *rows[:-1]], column.type)


def other_video(root: Path) -> None:
    write(root.parent / "long", replace(PLAN, lengths=(4, 5), gop=1))
    (root.parent / "long" / VIDEO.format("cam_high")).rename(root / VIDEO.format("cam_high"))


def changed_places(root: Path) -> None:
    table = pq.read_table(root / ROWS)
    places = {"action": "observation.state", "observation.state": "action"}
    pq.write_table(table.rename_columns([places.get(name, name) for name in table.column_names]), root / ROWS)


def other_task(root: Path) -> None:
    listed = root / layout.EPISODES
    listed.write_text(listed.read_text().replace("task 1", "task one"))


CHANGES: dict[str, Callable[[Path], None]] = {
    "a float": lambda root: with_column(
        root, "action", lambda old: pa.array([[0.0] * len(old[0])] * len(old), old.type)
    ),
    "an int": lambda root: with_column(root, "frame_index", lambda old: pa.array(range(1, len(old) + 1))),
    "two columns": changed_places,
    "a stored picture": lambda root: with_column(root, "observation.images.cam_side", other_pictures),
    "a video": other_video,
    "a task": other_task,
}


@pytest.mark.parametrize("change", CHANGES)
def test_an_episode_that_differs_in_anything_is_another_one(tmp_path: Path, change: str) -> None:
    one, other = written(tmp_path / "one"), written(tmp_path / "other")
    before = content_uuid(open_dataset(one), 1)
    assert content_uuid(open_dataset(other), 1) == before
    CHANGES[change](other)
    assert content_uuid(open_dataset(other), 1) != before
    copy_with_uuids(one, tmp_path / "copy")
    with pytest.raises(RecordingError, match="holds other episodes"):
        copy_with_uuids(other, tmp_path / "copy")


def test_an_episode_is_known_again_in_other_files_under_other_names_and_coded_again(tmp_path: Path) -> None:
    source = written(tmp_path / "source", replace(PLAN, version="v3.0"))  # its videos hold several episodes
    convert(source, tmp_path / "v21", layout.V21)
    known = [content_uuid(open_dataset(source), index) for index in (0, 1)]
    assert [content_uuid(open_dataset(tmp_path / "v21"), index) for index in (0, 1)] == known
    copy_with_uuids(
        source, tmp_path / "copy", rename={"observation.images.cam_side": "observation.images.left"}
    )
    copy_with_uuids(source, tmp_path / "again", reencode=True)
    for copy in ("copy", "again"):
        assert uuids_of(copy_with_uuids(source, tmp_path / copy).root) == dict(enumerate(known))


def test_what_an_earlier_version_imported_is_taken_with_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, said = written(tmp_path / "source"), []
    with monkeypatch.context() as before:
        before.setattr(episode_uuids, "content_uuid", episode_uuids._identity_of_numbers)
        copy_with_uuids(source, tmp_path / "copy")
    older = uuids_of(tmp_path / "copy")
    assert older[1] == OF_NUMBERS
    copy_with_uuids(source, tmp_path / "copy", tell=said.append)
    assert uuids_of(tmp_path / "copy") == older
    assert "compared numbers alone" in said[0]
    CHANGES["a float"](source)
    with pytest.raises(RecordingError, match="holds other episodes"):
        copy_with_uuids(source, tmp_path / "copy")
