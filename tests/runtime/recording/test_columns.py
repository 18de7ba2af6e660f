import math
import mmap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from runtime.core.errors import RecordingError
from runtime.ipc.messages import decode, encode
from runtime.ipc.shared_memory import Ring
from runtime.recording.admission import admit_tick
from runtime.recording.base import RawChunk
from runtime.recording.bench_truth import truth_changes, truth_text
from runtime.recording.columns import RecordedRow
from runtime.recording.layout import Layout
from runtime.recording.tables import SCHEMAS, TableWriter, read_table, write_table

from .samples import CAMERAS, STARTED, chunk, manifest, row, tick

LAYOUT = Layout.from_manifest(manifest())


def written(folder: Path, name: str, *records: object) -> pa.Table:
    writer = TableWriter(folder, name, LAYOUT)
    for record in records:
        writer.add(record)
    writer.finish()
    writer.file.close()
    return read_table(folder / f"{name}.arrow", SCHEMAS[name](LAYOUT)).table


def test_a_row_keeps_every_field_and_times_count_from_the_start(tmp_path: Path) -> None:
    records = [
        RecordedRow(row(0, eef=None), frozenset(CAMERAS[:1])),
        RecordedRow(row(1, control_source="hold", intervention=True), frozenset()),
    ]
    found = written(tmp_path, "rows", *records).to_pylist()
    assert found[1] == {
        "index": 1,
        "step": 3,
        "time": 1 / 30,
        "tick_time": pytest.approx(1 / 30),
        "sequence": 1,
        "qpos": [1, 1, 1],
        "action": [1.5, 1.5, 1.5],
        "qvel": [0, 0, 0],
        "eef": [0] * 8,
        "eef_action": [1] * 8,
        "eef_measured": True,
        "eef_action_reported": False,
        "control_source": "hold",
        "intervention": True,
        "capture_time.joints": pytest.approx(1 / 30 - 0.01),
        f"capture_time.{CAMERAS[0]}": pytest.approx(1 / 30 - 0.03),
        f"capture_time.{CAMERAS[1]}": pytest.approx(1 / 30 - 0.02),
        f"repeated.{CAMERAS[0]}": False,
        f"repeated.{CAMERAS[1]}": False,
        "skewed": False,
        f"lost.{CAMERAS[0]}": False,
        f"lost.{CAMERAS[1]}": False,
        f"stale.{CAMERAS[0]}": False,
        f"stale.{CAMERAS[1]}": False,
        "bench": None,
    }
    assert found[0]["eef"] is None
    assert found[0][f"repeated.{CAMERAS[0]}"] is True


def test_rows_whose_streams_are_too_far_apart_are_flagged(tmp_path: Path) -> None:
    layout = Layout.from_manifest(manifest(max_skew_s=0.05))
    captured = [
        {"joints": 1000.0, CAMERAS[0]: 1000.03, CAMERAS[1]: 999.99},
        {"joints": 1000.0, CAMERAS[0]: 1000.03, CAMERAS[1]: 999.97},
        {"joints": 1000.0, CAMERAS[0]: math.nan, CAMERAS[1]: 1000.06},
        {"joints": 1000.0},
        {},
    ]
    writer = TableWriter(tmp_path, "rows", layout)
    for index, times in enumerate(captured):
        writer.add(RecordedRow(row(index, captured=times), frozenset()))
    writer.finish()
    writer.file.close()
    found = read_table(tmp_path / "rows.arrow", SCHEMAS["rows"](layout)).table
    assert found.column("skewed").to_pylist() == [False, True, True, False, False]


def test_lost_and_old_pictures_are_flagged_by_camera(tmp_path: Path) -> None:
    records = [
        RecordedRow(row(0), frozenset(CAMERAS), frozenset(CAMERAS[1:])),
        RecordedRow(row(1, stale=frozenset(CAMERAS[:1])), frozenset(CAMERAS[:1])),
    ]
    found = written(tmp_path, "rows", *records)
    flags = {
        (flag, camera): found.column(f"{flag}.{camera}").to_pylist()
        for flag in ("lost", "stale")
        for camera in CAMERAS
    }
    assert flags == {
        ("lost", CAMERAS[0]): [False, False],
        ("lost", CAMERAS[1]): [True, False],
        ("stale", CAMERAS[0]): [False, True],
        ("stale", CAMERAS[1]): [False, False],
    }


def test_an_unknown_capture_time_is_not_a_number(tmp_path: Path) -> None:
    found = written(tmp_path, "rows", RecordedRow(row(0, captured={"joints": 1000.5}), frozenset()))
    assert found.column("capture_time.joints").to_pylist() == [0.5]
    assert math.isnan(found.column(f"capture_time.{CAMERAS[0]}")[0].as_py())


def test_a_tick_is_split_into_what_was_asked_for_and_what_was_done(tmp_path: Path) -> None:
    quiet = tick(2, smoothed=None, executed=None, chunk_ids=[], weights=[], notes=["stale"], refused=True)
    executed = written(tmp_path, "ticks", tick(1), quiet).to_pylist()
    assert executed[0]["executed"] == [1.5, 1.5, 1.5]
    assert executed[0]["chunk_id"] == 5
    assert executed[0]["planned"] == pytest.approx(0.01)
    assert executed[0]["sent"] == pytest.approx(0.011)
    assert executed[1]["executed"] is None
    assert executed[1]["chunk_id"] == -1
    assert executed[1]["refused"] is True
    assert executed[1]["changes"] == ["stale"]
    assert executed[0]["woke"] is None
    smoothed = written(tmp_path, "smoothed", tick(1)).to_pylist()
    assert smoothed == [
        {"step": 1, "smoothed": [1.25, 1.25, 1.25], "chunk_ids": [4, 5], "weights": [0.25, 0.75]}
    ]


@pytest.mark.parametrize(
    "changes", [{}, {"smoothed": None, "executed": None, "chunk_ids": [], "weights": []}]
)
def test_a_tick_that_came_over_the_ring_of_control_is_written_as_it_was_sent(changes, tmp_path: Path) -> None:
    sent = tick(1, woke=STARTED + 0.0125, **changes)
    ring = Ring(mmap.mmap(-1, Ring.size(4096)), 0, 4096)
    assert ring.push(encode(sent))
    [payload] = ring.drain()
    received = admit_tick(LAYOUT, decode(payload))
    folders = [tmp_path / side for side in ("sent", "received")]
    for folder in folders:
        folder.mkdir()
    for name in ["ticks"] if sent.smoothed is None else ["ticks", "smoothed"]:
        there, here = (written(*one) for one in zip(folders, (name, name), (sent, received), strict=True))
        assert here.equals(there)


def test_how_late_a_tick_was_is_in_its_row_and_null_in_episodes_from_before(tmp_path: Path) -> None:
    table = written(tmp_path, "ticks", tick(1, woke=STARTED + 0.0125))
    assert table["woke"].to_pylist() == [pytest.approx(0.0125)]
    assert table["planned"].to_pylist() == [pytest.approx(0.01)]
    write_table(tmp_path / "ticks.arrow", table.drop_columns(["woke"]))
    older = read_table(tmp_path / "ticks.arrow", SCHEMAS["ticks"](LAYOUT)).table
    assert older["woke"].to_pylist() == [None]
    assert older["step"].to_pylist() == [1]


def test_what_a_bench_said_is_kept_where_it_was_something_new_and_episodes_from_before_have_none(
    tmp_path: Path,
) -> None:
    said = truth_text({"blocks": [[0.123456, 0.0, 0.02, 1.0]], "plate": [0.3, math.nan], "seed": 7})
    assert said == '{"blocks":[[0.1235,0.0,0.02,1.0]],"plate":[0.3,null]}'
    records = [RecordedRow(row(index, bench=said if index == 1 else None), frozenset()) for index in range(3)]
    table = written(tmp_path, "rows", *records)
    assert truth_changes(table) == [(1, {"blocks": [[0.1235, 0.0, 0.02, 1.0]], "plate": [0.3, None]})]
    write_table(tmp_path / "rows.arrow", table.drop_columns(["bench"]))
    assert truth_changes(read_table(tmp_path / "rows.arrow", SCHEMAS["rows"](LAYOUT)).table) == []


def test_chunks_of_any_width_become_one_row_per_action(tmp_path: Path) -> None:
    found = written(tmp_path, "raw", chunk(1, horizon=2, width=3), chunk(2, horizon=1, width=1)).to_pylist()
    assert [line["chunk_id"] for line in found] == [1, 1, 2]
    assert [line["index"] for line in found] == [0, 1, 0]
    assert [line["target_step"] for line in found] == [-1, 11, -1]
    assert [line["action"] for line in found] == [[0, 1, 2], [3, 4, 5], [0]]
    assert {(line["space"], line["delay"], line["inference_ms"]) for line in found} == {("joint", 1, 42.5)}


def test_numbers_survive_bit_by_bit(tmp_path: Path) -> None:
    values = np.array([np.nan, -0.0, 1e-42], dtype=np.float32)
    found = (
        written(tmp_path, "ticks", tick(0, qpos=values)).column("qpos").combine_chunks().flatten().to_numpy()
    )
    assert found.tobytes() == values.tobytes()


def test_a_chunk_says_which_strategy_merged_it_and_over_how_many_steps(tmp_path: Path) -> None:
    merged = replace(chunk(1, horizon=2), strategy="rtc", overlap=6)
    found = written(tmp_path, "raw", merged, chunk(2, horizon=1)).to_pylist()
    assert [(row["strategy"], row["overlap"]) for row in found] == [("rtc", 6), ("rtc", 6), ("", 0)]


METRES = np.array([[0.5, np.nan], [0.25, 0.0]], np.float32)
FLAGS = np.array([[1, 0], [3, 8]], np.uint8)


def met() -> RawChunk:
    figures = {"ik_position_error": METRES, "ik_rotation_error": 2 * METRES, "ik_flags": FLAGS}
    return replace(chunk(1, horizon=2), space="eef", eef="measured", **figures)


def test_how_poses_were_met_is_in_their_rows_arm_by_arm_and_null_for_joints(tmp_path: Path) -> None:
    found = written(tmp_path, "raw", met(), chunk(2, horizon=1)).to_pylist()
    assert [row["ik_flags"] for row in found] == [[1, 0], [3, 8], None]
    assert found[1]["ik_position_error"] == [0.25, 0.0]
    assert found[1]["ik_rotation_error"] == [0.5, 0.0]
    assert math.isnan(found[0]["ik_position_error"][1])
    assert found[2]["ik_position_error"] is None
    assert [row["eef_source"] for row in found] == ["measured", "measured", None]


IK = ["ik_position_error", "ik_rotation_error", "ik_flags", "eef_source"]


@pytest.mark.parametrize("absent", [IK, [*IK, "strategy", "overlap"]])
def test_episodes_of_every_generation_still_open(tmp_path: Path, absent: list[str]) -> None:
    table = written(tmp_path, "raw", met())
    write_table(tmp_path / "raw.arrow", table.drop_columns(absent))
    older = read_table(tmp_path / "raw.arrow", SCHEMAS["raw"](LAYOUT)).table
    assert older.column_names == table.column_names
    assert [older[name].to_pylist() for name in absent] == [[None, None]] * len(absent)
    assert older["action"].to_pylist() == table["action"].to_pylist()


def test_a_table_of_no_generation_is_refused(tmp_path: Path) -> None:
    table = written(tmp_path, "raw", met())
    write_table(tmp_path / "raw.arrow", table.drop_columns(["strategy", "ik_flags"]))
    with pytest.raises(RecordingError, match="other columns"):
        read_table(tmp_path / "raw.arrow", SCHEMAS["raw"](LAYOUT))
