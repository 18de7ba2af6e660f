"""One table per run: everything of the three streams at its place, and the place never outside the data folder."""

import json
import os
import threading
import uuid
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import RecordingError
from runtime.recording import export as exporting
from runtime.recording.base import Outcome
from runtime.recording.episode import EpisodeJournal
from runtime.recording.export import FOLDER, NO_PROMPT, SCHEMA, export_path, is_exported, slug, write_export
from runtime.recording.files import to_json

from .samples import DIM, SETTINGS, STARTED, chunk, manifest, row, tick, unsealed


def recorded(root: Path, **changes: Any) -> Path:
    """A finished episode of 16 ticks: steps 0 to 3 made by nobody, one where nothing was sent; three chunks."""
    journal = EpisodeJournal(root / "episodes", SETTINGS)
    journal.begin(manifest(**changes))
    assert journal.folder is not None
    folder = journal.folder
    journal.append(row(0))
    for k in range(16):
        made = {"chunk_ids": [0, 1], "weights": [0.75, 0.25]} if k == 4 else {}
        made |= {"smoothed": None, "chunk_ids": (), "weights": (), "notes": ()} if k < 4 else {}
        made |= {"executed": None, "refused": True} if k == 7 else {}
        made |= {"woke": STARTED + k / 100 + 0.0005} if k == 5 else {}
        journal.append(tick(k, **made))
    known, lost = chunk(1), chunk(3)
    journal.append(replace(known, strategy="rtc", overlap=5, mistimed=2))
    journal.append(replace(lost, arrival_step=-1, delay=-1, target_steps=known.target_steps * 0 - 1))
    journal.end(Outcome("finished", "done", 1.7e9, {"policy": {"answers": 2}}))
    return folder


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    return write_export(recorded(root), root)


def rows(path: Path, stream: str) -> list[dict[str, Any]]:
    """The rows of a stream, without what is null in them."""
    found = [line for line in pq.read_table(path).to_pylist() if line["stream"] == stream]
    return [{name: value for name, value in line.items() if value is not None} for line in found]


def test_it_lies_where_prompt_mode_and_strategy_say(exported: Path) -> None:
    assert exported.parts[-4:-1] == ("stack-the-blocks", "continuous", "async")
    assert uuid.UUID(exported.stem).version == 4
    assert [path.name for path in exported.parent.iterdir()] == [exported.name], "no draft is left"


def test_every_row_of_every_chunk_says_where_it_was_meant_for(exported: Path) -> None:
    raw = rows(exported, "raw")
    assert len(raw) == 8
    assert raw[1] == {
        "stream": "raw",
        "step": 11,
        "time": pytest.approx(0.11),
        "chunk_id": 1,
        "observation_step": 10,
        "arrival_step": 11,
        "index": 1,
        "target_step": 11,
        "delay": 1,
        "mistimed": 2,
        "overlap": 5,
        "strategy": "rtc",
        "inference_ms": 42.5,
        "space": "joint",
        "action": [2.0, 3.0],
    }


def test_what_was_dropped_or_never_arrived_has_no_step(exported: Path) -> None:
    raw = rows(exported, "raw")
    assert not {"step", "time", "target_step"} & set(raw[0]), "its first row came too late"
    assert raw[0]["arrival_step"] == 11
    for line in raw[4:]:
        assert not {"step", "arrival_step", "delay", "strategy"} & set(line)


def test_a_smoothed_step_names_its_makers_and_their_weights(exported: Path) -> None:
    smoothed = rows(exported, "smoothed")
    assert [line["step"] for line in smoothed] == list(range(4, 16))
    assert (smoothed[0]["chunk_ids"], smoothed[0]["weights"]) == ([0, 1], [0.75, 0.25])
    assert [line["chunk_id"] for line in smoothed[:2]] == [0, 5], "the held target leads where it weighs most"
    assert smoothed[1]["action"] == [5.25] * DIM
    assert smoothed[1]["time"] == pytest.approx(0.05)


def test_an_executed_step_says_what_safety_did(exported: Path) -> None:
    executed = rows(exported, "executed")
    assert len(executed) == 16
    assert "chunk_id" not in executed[0]
    assert executed[5]["action"] == [5.5] * DIM
    assert executed[5]["measured"] == [5.0] * DIM
    assert (executed[5]["changes"], executed[5]["refused"]) == (["speed"], False)
    assert executed[5]["sent"] - executed[5]["time"] == pytest.approx(0.001)
    assert executed[5]["woke"] - executed[5]["time"] == pytest.approx(0.0005)
    assert "woke" not in executed[6], "as in lockstep"
    assert executed[7]["refused"] is True
    assert "action" not in executed[7]


def test_manifest_and_outcome_stand_in_its_metadata(exported: Path) -> None:
    told = pq.read_schema(exported).metadata
    assert told[b"eva.prompt"] == b"stack the blocks"
    assert json.loads(told[b"eva.manifest"])["uuid"] == exported.stem
    assert json.loads(told[b"eva.manifest"])["started_monotonic"] == STARTED
    assert json.loads(told[b"eva.outcome"])["policy"] == {"answers": 2}
    assert pq.read_schema(exported).names == SCHEMA.names


def test_each_stream_begins_a_row_group(exported: Path) -> None:
    file = pq.ParquetFile(exported)
    groups = [set(file.read_row_group(k)["stream"].to_pylist()) for k in range(file.num_row_groups)]
    assert groups == [{"raw"}, {"smoothed"}, {"executed"}]


def test_exporting_again_writes_nothing_until_the_episode_was_repaired(tmp_path: Path) -> None:
    folder = recorded(tmp_path)
    first = write_export(folder, tmp_path)
    before = first.stat()
    assert write_export(folder, tmp_path) == first
    assert first.stat().st_mtime_ns == before.st_mtime_ns
    assert first.stat().st_ino == before.st_ino
    content = first.read_bytes()
    os.utime(folder / "outcome.json", ns=(before.st_mtime_ns + 1, before.st_mtime_ns + 1))
    assert not is_exported(folder, first)
    write_export(folder, tmp_path)
    assert first.stat().st_ino != before.st_ino
    assert first.read_bytes() == content


def test_several_at_once_leave_one_whole_table(tmp_path: Path) -> None:
    folder = recorded(tmp_path)
    threads = [threading.Thread(target=write_export, args=(folder, tmp_path)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (path,) = (tmp_path / FOLDER).rglob("*.parquet*")
    assert pq.read_table(path).num_rows == 8 + 12 + 16


def test_what_has_no_outcome_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    folder = recorded(tmp_path)
    (folder / "outcome.json").unlink()
    with pytest.raises(RecordingError, match=r"has no outcome\.json"):
        write_export(folder, tmp_path)
    assert not (tmp_path / FOLDER).exists()


def test_an_episode_that_lost_a_table_or_a_video_is_exported_with_what_there_is(tmp_path: Path) -> None:
    folder = recorded(tmp_path)
    (folder / "ticks.arrow").unlink()
    next(folder.glob("*.mp4")).unlink()
    unsealed(folder)
    path = write_export(folder, tmp_path)
    assert rows(path, "executed") == []
    assert len(rows(path, "smoothed")) == 12
    assert "time" not in rows(path, "raw")[1]


def test_a_disk_that_takes_nothing_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = recorded(tmp_path)
    (tmp_path / FOLDER).write_text("in the way")
    with pytest.raises(RecordingError, match="exports"):
        write_export(folder, tmp_path)


@pytest.mark.parametrize(
    ("prompt", "name"),
    [
        ("pick up the cube", "pick-up-the-cube"),
        ("", NO_PROMPT),
        ("  \n", NO_PROMPT),
        (None, NO_PROMPT),
        ("拿起 方块", "拿起-方块"),
    ],
)
def test_plain_prompts_keep_their_words(prompt: str | None, name: str) -> None:
    assert slug(prompt, NO_PROMPT) == name


@pytest.mark.parametrize(
    ("prompt", "begins"),
    [
        ("../../etc/passwd", "etc-passwd-"),
        ("Pick up the cube!", "Pick-up-the-cube-"),
        ("no prompt", "no-prompt-"),
        ("/", ""),
        ("..", ""),
        ("a" * 500, "a" * 120 + "-"),
        ("\u202e\x00", ""),
    ],
)
def test_what_a_name_cannot_hold_gets_a_mark(prompt: str, begins: str) -> None:
    name = slug(prompt, NO_PROMPT)
    assert name.startswith(begins)
    assert len(name) == len(begins) + 8


@given(prompt=st.text(), mode=st.text(), strategy=st.text())
def test_whatever_a_manifest_says_the_table_stays_below_the_data_folder(
    prompt: str, mode: str, strategy: str
) -> None:
    root = Path("/data")
    path = export_path(manifest(task=prompt, mode=mode, strategy=strategy), root)
    parts = path.relative_to(root).parts
    assert len(parts) == 5
    assert parts[0] == FOLDER
    for part in parts[1:]:
        assert part not in ("", ".", "..")
        assert "/" not in part
        assert len(part.encode()) <= 160


@given(one=st.text(min_size=1), other=st.text(min_size=1))
def test_two_prompts_never_share_a_folder(one: str, other: str) -> None:
    if one.strip() and other.strip() and one != other:
        assert slug(one) != slug(other)


def test_a_manifest_whose_uuid_leads_elsewhere_is_refused(tmp_path: Path) -> None:
    folder = recorded(tmp_path)
    told = json.loads((folder / "manifest.json").read_text()) | {"uuid": "../../outside"}
    (folder / "manifest.json").write_bytes(to_json(told, "the manifest"))
    with pytest.raises(RecordingError, match="uuid"):
        write_export(folder, tmp_path)


def test_a_long_run_is_many_row_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exporting, "_ROWS_TOGETHER", 5)
    path = write_export(recorded(tmp_path), tmp_path)
    assert pq.ParquetFile(path).num_row_groups == 2 + 3 + 4
    assert len(rows(path, "executed")) == 16
