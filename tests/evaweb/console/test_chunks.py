"""A chunk becomes dots where its rows take the fingertips, and robots where it is proposed."""

from __future__ import annotations

import numpy as np
import pytest

from evaweb.console import frame_parts
from evaweb.console.encoder import GHOSTS, encode_chunk
from evaweb.core.binary_frames import decode
from evaweb.stations.geometry import scene_geometry
from evaweb.stations.robot_geometry import drawn_robot

LOOKS = drawn_robot("agilex_piper")


def chunk(count=16, **changes):
    rows = np.linspace(0.0, 0.4, count, dtype=np.float32)[:, None] * np.ones(14, np.float32)
    return {
        "chunk": 7,
        "run": 2,
        "state": "merged",
        "observation_step": 40,
        "step": 44,
        "targets": np.arange(40, 40 + count),
        "rows": rows,
        "poses": np.zeros((count, 16), np.float32),
        "overlap": 8,
    } | changes


def shown(content, looks=LOOKS):
    frame = decode(frame_parts.build_frame([encode_chunk(content, looks, 0.0)], 1, 0.0))
    return frame, frame.header["streams"]["chunk"]


def test_the_runtimes_words_and_the_step_of_every_row_are_passed_on():
    _, entry = shown(chunk())
    assert {
        key: entry["json"][key] for key in ("chunk", "run", "state", "observation_step", "step", "overlap")
    } == {
        "chunk": 7,
        "run": 2,
        "state": "merged",
        "observation_step": 40,
        "step": 44,
        "overlap": 8,
    }
    assert entry["json"]["targets"] == list(range(40, 56))


def test_dots_are_where_the_robots_fingertips_would_be():
    content = chunk()
    frame, _ = shown(content)
    tips = frame.array("chunk", "tips")
    assert tips.shape == (16, 2, 3)
    for arm, tip in enumerate(scene_geometry("agilex_piper")["tips"]):
        part = LOOKS.poses(content["rows"][5])[tip["part"]].reshape(4, 4).T
        assert np.allclose(tips[5, arm], (part @ np.reshape(tip["pose"], (4, 4)).T)[:3, 3], atol=1e-6)


@pytest.mark.parametrize(("count", "rows"), [(1, [0]), (5, [0, 1, 2, 3, 4]), (50, None)])
def test_a_proposed_chunk_has_robots_from_its_first_row_to_its_last(count, rows):
    content = chunk(count, state="proposed", targets=np.full(count, -1))
    frame, entry = shown(content)
    drawn = entry["json"]["ghost_rows"]
    assert drawn == rows or (drawn[0], drawn[-1], len(drawn)) == (0, count - 1, GHOSTS)
    assert np.allclose(frame.array("chunk", "ghost")[-1], LOOKS.poses(content["rows"][-1]), atol=1e-6)


def test_a_merged_chunk_has_no_robots():
    assert set(shown(chunk())[1]["arrays"]) == {"tips"}


@pytest.mark.parametrize(
    ("content", "looks"),
    [
        (chunk(), None),
        (chunk(rows=np.full((16, 14), np.nan, np.float32)), LOOKS),
        (chunk(rows=np.zeros((16, 7), np.float32)), LOOKS),
        (chunk(rows=np.zeros((0, 14), np.float32), targets=np.zeros(0, int)), LOOKS),
    ],
)
def test_what_cannot_be_drawn_is_still_told(content, looks):
    _, entry = shown(content, looks)
    assert entry["json"]["chunk"] == 7
    assert "arrays" not in entry


def test_that_there_is_no_chunk_any_more_is_told():
    assert shown({"chunk": 0})[1] == {"json": {"chunk": 0}}
