from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from runtime.core.errors import RecordingError
from runtime.recording.admission import admit_chunk, admit_row, admit_tick
from runtime.recording.base import RawChunk
from runtime.recording.layout import Layout

from .samples import CAMERAS, chunk, manifest, numbered, row, tick

LAYOUT = Layout.from_manifest(manifest())


def test_a_row_is_copied_and_gives_up_its_pictures() -> None:
    given = row(0)
    admitted = admit_row(LAYOUT, given, 0)
    given.qpos[:] = 9
    assert admitted.qpos.tolist() == [0, 0, 0]
    assert admitted.pictures == {}
    assert admitted.eef_measured


def test_a_vector_that_the_manifest_does_not_list_is_left_out() -> None:
    assert admit_row(LAYOUT, row(0, effort=np.ones(3, np.float32)), 0).effort is None


def test_a_listed_vector_may_be_unknown() -> None:
    assert admit_row(LAYOUT, row(0, eef=None), 0).eef is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"qpos": np.zeros(4, np.float32)}, r"row 0: qpos has shape \(4,\), must be \(3,\)"),
        ({"action": np.float32(1)}, "action has shape"),
        ({"eef": np.zeros((1, 8), np.float32)}, "eef has shape"),
        ({"pictures": {CAMERAS[0]: None}}, "pictures of"),
        ({"pictures": {**dict.fromkeys(CAMERAS), "observation.images.spare": None}}, "spare"),
        ({"pictures": {**dict.fromkeys(CAMERAS), CAMERAS[1]: numbered(1)[:24]}}, "wrist gave uint8"),
        ({"pictures": {**dict.fromkeys(CAMERAS), CAMERAS[0]: numbered(1) / 255}}, "front gave float64"),
    ],
)
def test_a_row_that_does_not_fit_is_refused_by_name(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        admit_row(LAYOUT, row(0, **changes), 0)


@pytest.mark.parametrize("expected", [0, 2])
def test_rows_are_neither_skipped_nor_repeated(expected: int) -> None:
    with pytest.raises(RecordingError, match=f"row 1 given, row {expected} is next"):
        admit_row(LAYOUT, row(1), expected)


def test_a_tick_is_copied() -> None:
    given = tick(3, smoothed=None)
    admitted = admit_tick(LAYOUT, given)
    given.qpos[:] = 9
    assert admitted.qpos.tolist() == [3, 3, 3]
    assert admitted.smoothed is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"executed": np.zeros(2, np.float32)}, "tick 3: executed has shape"),
        ({"smoothed": np.zeros(5, np.float32)}, "tick 3: smoothed has shape"),
        ({"weights": [1.0]}, "2 chunk_ids and 1 weights"),
    ],
)
def test_a_tick_that_does_not_fit_is_refused_by_name(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        admit_tick(LAYOUT, tick(3, **changes))


def test_a_chunk_needs_one_target_per_row() -> None:
    good = chunk(7)
    assert admit_chunk(good).actions.shape == (4, 2)
    bad = RawChunk(7, 10, 11, good.actions, good.target_steps[:3], "joint", 1)
    with pytest.raises(RecordingError, match=r"chunk 7: actions \(4, 2\) and target_steps \(3,\)"):
        admit_chunk(bad)


def test_how_poses_were_met_is_said_of_every_row_or_of_none() -> None:
    flags = np.zeros((4, 2), np.uint8)
    admitted = admit_chunk(replace(chunk(7), ik_flags=flags))
    flags[0] = 3
    assert admitted.ik_flags is not None
    assert not admitted.ik_flags.any()
    with pytest.raises(RecordingError, match=r"chunk 7: ik_flags \(3, 2\), must be \[4, arms\]"):
        admit_chunk(replace(chunk(7), ik_flags=flags[:3]))
