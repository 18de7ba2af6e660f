"""Curves and poses: what is drawn is what was recorded, on the clock of the videos."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from evaweb.core.binary_frames import decode
from evaweb.core.errors import NotFound
from evaweb.episodes import poses as posing
from evaweb.episodes.curves import _interventions, curve_message, hold_spans
from evaweb.episodes.poses import pose_message
from evaweb.stations.robot_geometry import drawn_robot
from runtime.kinematics.base import ChainForward
from runtime.recording.files import RecordingError
from runtime.recording.reader import open_episode
from runtime.recording.tables import write_table
from runtime.spaces.end_effectors import EndEffectors
from tests.runtime.lockstep_station import STANDS, Station, column, stubbed
from tests.runtime.recording.test_tables import old_raw


@pytest.fixture(scope="module")
def folder(recorded: dict[str, Path]) -> Path:
    return recorded["finished"]


def test_every_tick_has_what_was_measured_asked_for_and_sent(folder: Path) -> None:
    frame, episode = decode(curve_message(folder)), open_episode(folder)
    time = frame.array("ticks", "time")
    assert time[0] == 0
    assert np.allclose(time, np.arange(len(time)) / 30)
    assert frame.header["frames"] == episode.frames
    assert frame.header["joints"][7] == "right_arm.joint0"
    assert (frame.header["units"][0], frame.header["units"][6]) == ("rad", "m")
    assert np.array_equal(frame.array("ticks", "measured").T, column(episode.ticks, "qpos"))
    assert np.array_equal(frame.array("ticks", "executed").T, column(episode.ticks, "executed"))
    smoothed = frame.array("ticks", "smoothed").T
    steps = column(episode.ticks, "step").tolist()
    asked = column(episode.smoothed, "step").tolist()
    places = [steps.index(step) for step in asked]
    assert np.array_equal(smoothed[places], column(episode.smoothed, "smoothed"))
    others = sorted(set(range(len(steps))) - set(places))
    assert others
    assert np.isnan(smoothed[others]).all()


def test_the_policys_own_rows_lie_at_the_step_they_were_meant_for(folder: Path) -> None:
    frame, episode = decode(curve_message(folder)), open_episode(folder)
    used = [row for row in episode.raw.to_pylist() if row["target_step"] >= 0]
    first = episode.ticks["step"][0].as_py()
    assert len(used) > 10
    assert np.allclose(frame.array("raw", "time"), [(row["target_step"] - first) / 30 for row in used])
    assert np.array_equal(
        frame.array("raw", "values").T, np.array([row["action"] for row in used], np.float32)
    )
    assert frame.array("raw", "chunk").tolist() == [row["chunk_id"] for row in used]
    assert frame.header["streams"]["raw"]["json"]["spaces"] == ["joint"]


@pytest.mark.parametrize(
    ("hands", "marks"),
    [
        ([0, 1, 1, 0, 0, 1], [(0.1, "0.2"), (0.5, "0.1")]),
        ([1, 1, 0, 0, 0, 0], [(0.0, "0.2")]),
        ([1] * 6, []),  # demonstrated from its beginning to its end
        ([0] * 6, []),
    ],
)
def test_interventions_are_marked(folder: Path, hands: list[int], marks: list[tuple[float, str]]) -> None:
    episode = open_episode(folder)
    rows = pa.table({"intervention": [bool(one) for one in hands]})
    found = _interventions(replace(episode, rows=rows, layout=replace(episode.layout, fps=10.0)))
    assert [(mark["time"], mark["text"]) for mark in found] == [
        (time, f"a person intervenes for {seconds} s") for time, seconds in marks
    ]


def test_held_spans_and_events_are_on_the_same_clock(folder: Path) -> None:
    frame, episode = decode(curve_message(folder)), open_episode(folder)
    sources = column(episode.rows, "control_source").tolist()
    held = sum(round((to - since) * 30) for since, to in frame.header["held"])
    assert held == sources.count("hold") + sources.count("none") > 0
    marks = {mark["text"].split(" by ")[0]: mark["time"] for mark in frame.header["marks"]}
    halted = next(since for since, to in frame.header["held"] if since > 0)
    assert marks["halt"] == pytest.approx(halted, abs=1.5 / 30)
    assert marks["run"] == 0


@pytest.mark.parametrize(
    ("sources", "spans"),
    [
        ([], []),
        (["policy"], []),
        (["hold"], [[0.0, 0.1]]),
        (["policy", "hold", "none", "policy", "hold"], [[0.1, 0.3], [0.4, 0.5]]),
    ],
)
def test_spans_of_rows_in_which_nobody_asked(sources: list[str], spans: list[list[float]]) -> None:
    assert np.allclose(hold_spans(sources, 10.0), spans)


def test_a_policy_that_speaks_in_poses_has_no_raw_joint_curve(tmp_path: Path) -> None:
    made = stubbed(tmp_path, space="eef")
    eef_of = EndEffectors(made.spec.robot, ChainForward(made.spec.robot)).eef_of
    made.rows = lambda seen, number: eef_of(np.tile(STANDS, (20, 1)))
    bench = Station(made)
    bench.running(12)
    frame = decode(curve_message(bench.stop().path))
    assert frame.header["streams"]["raw"]["json"]["spaces"] == ["eef"]
    assert frame.header["streams"]["raw"]["json"]["rows"] > 0
    assert frame.array("raw", "values").shape == (14, 0)
    assert np.isfinite(frame.array("ticks", "executed")).all()


def test_poses_are_those_of_the_measured_joints_and_come_in_parts(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(posing, "MOST_ROWS", 10)
    episode = open_episode(folder)
    looks = drawn_robot("agilex_piper")
    wanted = looks.scene.poses(column(episode.rows, "qpos").astype(np.float64))
    for first, count in ((0, 10), (20, episode.frames - 20)):
        frame = decode(pose_message(folder, first))
        found = frame.array("poses")
        assert found.shape == (count, len(looks.scene.parts), 16)
        matrices = found.reshape(count, -1, 4, 4).swapaxes(-1, -2)  # column by column
        assert np.allclose(matrices, wanted[first : first + count], atol=1e-6)
        assert frame.header["rows"] == episode.frames


@pytest.mark.parametrize("first", [-1, 24, 5000])
def test_a_row_that_there_is_not_is_refused(folder: Path, first: int) -> None:
    with pytest.raises(NotFound, match="has rows 0 to 23"):
        pose_message(folder, first)


def test_a_robot_that_nobody_knows_any_more_leaves_curves_without_units(put: object) -> None:
    folder = put()  # type: ignore[operator]
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["robot"]["name"] = "retired"
    (folder / "manifest.json").write_text(json.dumps(manifest))
    assert decode(curve_message(folder)).header["units"] == [""] * 14


def test_a_table_of_zeros_has_no_curve_and_rows_that_are_missing_are_told(put: object) -> None:
    folder = put()  # type: ignore[operator]
    (folder / "ticks.arrow").write_bytes(bytes(100))
    assert decode(curve_message(folder)).array("ticks", "time").size == 0
    (folder / "rows.arrow").unlink()
    with pytest.raises(RecordingError, match=r"rows\.arrow is damaged: 0 rows readable"):
        curve_message(folder)


# --- chunks --------------------------------------------------------------------------------------------------


def test_every_tick_names_the_chunk_that_owns_it_and_all_that_made_it(folder: Path) -> None:
    frame, episode = decode(curve_message(folder)), open_episode(folder)
    owners = frame.array("ticks", "chunk")
    assert owners.tolist() == episode.ticks["chunk_id"].to_pylist()
    offsets, ids = frame.array("ticks", "makers"), frame.array("makers", "chunk")
    weights = frame.array("makers", "weight")
    made = {row["step"]: row for row in episode.smoothed.to_pylist()}
    assert len(offsets) == len(owners) + 1
    assert offsets[-1] == len(ids) == len(weights) > 0
    for tick, step in enumerate(episode.ticks["step"].to_pylist()):
        part = slice(offsets[tick], offsets[tick + 1])
        assert ids[part].tolist() == made.get(step, {"chunk_ids": []})["chunk_ids"]
        assert np.allclose(weights[part], made.get(step, {"weights": []})["weights"])
        assert owners[tick] in (ids[part] if len(ids[part]) else [-1])
    assert max(np.diff(offsets)) > 1, "some steps are made of several chunks"


def test_of_every_chunk_it_is_known_when_and_how_late_it_came(tmp_path: Path) -> None:
    bench = Station(stubbed(tmp_path, delay=3))
    bench.running(40)
    folder = bench.stop().path
    frame, episode = decode(curve_message(folder)), open_episode(folder)
    told = {name: frame.array("chunks", name) for name in frame.header["streams"]["chunks"]["arrays"]}
    raw = episode.raw.to_pylist()
    assert told["id"].tolist() == sorted({row["chunk_id"] for row in raw})
    assert frame.header["streams"]["chunks"]["json"]["strategies"] == ["async"]
    assert frame.header["period"] == pytest.approx(1 / 30)
    arrived = ~np.isnan(told["arrived"])
    assert set(told["delay"][arrived].tolist()) == {3}
    assert np.allclose((told["arrived"] - told["observed"])[arrived], 0.1)
    assert set(told["rows"].tolist()) == {20}
    for chunk, first, last in zip(told["id"], told["first"], told["last"], strict=True):
        planned = [row["index"] for row in raw if row["chunk_id"] == chunk and row["target_step"] >= 0]
        assert (first, last) == ((min(planned), max(planned)) if planned else (-1, -1))


def test_a_chunk_that_never_arrived_and_an_older_episode_leave_unknown_what_is_unknown(put: object) -> None:
    folder = put()  # type: ignore[operator]
    old_raw(folder / "raw.arrow")
    frame = decode(curve_message(folder))
    told = {
        name: frame.array("chunks", name).tolist() for name in ("id", "first", "last", "overlap", "strategy")
    }
    assert told == {"id": [1], "first": [1], "last": [3], "overlap": [-1], "strategy": [-1]}
    table = pa.ipc.open_stream((folder / "raw.arrow").read_bytes()).read_all()
    lost = table.set_column(2, "arrival_step", pa.array([-1] * 4, pa.int64()))
    write_table(folder / "raw.arrow", lost)
    frame = decode(curve_message(folder))
    assert np.isnan(frame.array("chunks", "arrived")).all()
    assert frame.array("chunks", "delay").tolist() == [-1]


def test_an_episode_of_no_chunks_has_none(put: object) -> None:
    folder = put()  # type: ignore[operator]
    for name in ("raw", "smoothed"):
        (folder / f"{name}.arrow").unlink()
    frame = decode(curve_message(folder))
    assert frame.array("chunks", "id").size == frame.array("makers", "chunk").size == 0
    assert not frame.array("ticks", "makers").any()
