"""Whatever happens to a file of a recording is found, named with its rows, and never published or played."""

from __future__ import annotations

import errno
import hashlib
import itertools
import json
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from runtime.core.clock import VirtualClock
from runtime.core.errors import PolicyError, RecordingError
from runtime.datasets.__main__ import main as datasets
from runtime.datasets.importing import SourceRobot, import_episode
from runtime.datasets.publishing import publish
from runtime.datasets.reader import Dataset, open_dataset
from runtime.ipc.messages import ExecutedTick
from runtime.policies.replay import Config, ReplayPolicy
from runtime.recording.__main__ import main
from runtime.recording.base import Outcome, RawChunk
from runtime.recording.episode import EpisodeJournal
from runtime.recording.integrity import UNSEALED, DamagedError
from runtime.recording.layout import Layout
from runtime.recording.outcome_seal import (
    DIGESTS,
    SEAL,
    digest_of,
    digests_of,
    read_outcome,
)
from runtime.recording.quarantine import marked_damage, update_mark
from runtime.recording.repair import PLAN, repair, repair_all
from runtime.recording.scrub import verify_episode
from runtime.recording.settings import RecordingSettings
from runtime.recording.tables import SCHEMAS, read_table
from tests.processes import PATIENCE_S
from tests.runtime.datasets.small import manifest, robot, row

from .samples import unended, unsealed

FRAMES, DIM = 45, 6
SETTINGS = RecordingSettings(min_free_bytes=0, flush_period_s=0.02, drain_timeout_s=PATIENCE_S)


def tick(step: int) -> ExecutedTick:
    joints = np.full(DIM, step, np.float32)
    return ExecutedTick(step, 1, step / 30, step / 30, step, "policy", joints, joints, joints, [1], [1.0])


def chunk(number: int) -> RawChunk:
    targets = np.arange(number, number + 4, dtype=np.int64)
    return RawChunk(number, number, number, np.zeros((4, DIM), np.float32), targets, "joint", 0)


def begun(root: Path) -> EpisodeJournal:
    journal = EpisodeJournal(root, SETTINGS, patient=True)
    journal.begin(manifest(control_rate=30.0))
    for k in range(FRAMES):
        journal.append(row(k, 0))
        journal.append(tick(k))
        journal.append(chunk(k + 1))
        journal.append_event({"kind": "note", "text": str(k)})
        if k % 15 == 14:
            _flushed(journal, k + 1)
    return journal


def _flushed(journal: EpisodeJournal, rows: int) -> None:
    """Wait until so many rows, and the answers of the policy with them, are batches on the disk."""
    folder = journal.folder
    assert folder is not None
    layout = Layout.from_manifest(json.loads((folder / "manifest.json").read_text()))
    while read_table(folder / "raw.arrow", SCHEMAS["raw"](layout)).table.num_rows < 4 * rows:
        time.sleep(0.005)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with one recording, and the dataset that it was published into."""
    data = tmp_path_factory.mktemp("lab")
    journal = begun(data / "episodes")
    folder = journal.folder
    assert folder is not None
    journal.end(Outcome("finished", "", 1.7e9))
    publish(folder, data / "set")
    return data


@pytest.fixture(scope="module")
def dataset(lab: Path) -> Dataset:
    return open_dataset(lab / "set")


def episode_in(data: Path) -> Path:
    (folder,) = (data / "episodes").iterdir()
    return folder


@pytest.fixture
def folder(lab: Path, tmp_path: Path) -> Path:
    shutil.copytree(lab / "episodes", tmp_path / "data/episodes")
    return episode_in(tmp_path / "data")


def scrubbed(path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, list[dict[str, object]]]:
    capsys.readouterr()
    code = main(["scrub", str(path), "--json"])
    return code, [json.loads(line) for line in capsys.readouterr().out.splitlines()]


# --- what is written -----------------------------------------------------------------------------------------


def test_what_was_recorded_is_sound_and_its_digests_are_those_of_any_other_program(folder: Path) -> None:
    verdict = verify_episode(folder)
    assert (verdict.state, verdict.damage) == ("sound", ())
    digests = read_outcome(folder)[DIGESTS]
    assert set(digests) == {path.name for path in folder.iterdir()} - {"outcome.json", "sealed.json"}
    for name, told in digests.items():
        content = (folder / name).read_bytes()
        assert (told["bytes"], told["sha256"]) == (len(content), hashlib.sha256(content).hexdigest())
    assert verdict.bytes == sum(told["bytes"] for told in digests.values())


def test_what_the_recorder_counted_in_its_files_is_what_lies_there(folder: Path) -> None:
    layout = Layout.from_manifest(json.loads((folder / "manifest.json").read_text()))
    for name, told in read_outcome(folder)[DIGESTS].items():
        found = digest_of(folder / name, layout)
        if name != "events.jsonl":  # one piece for each time that it was written
            assert found == told, name
        assert found["sha256"] == told["sha256"]
    rows = {name: int(told["pieces"][-1].split()[1]) for name, told in read_outcome(folder)[DIGESTS].items()}
    videos = {"cam_high.mp4": FRAMES, "cam_wrist.mp4": FRAMES}
    tables = {"rows.arrow": FRAMES, "ticks.arrow": FRAMES, "smoothed.arrow": FRAMES, "raw.arrow": 4 * FRAMES}
    assert rows == {**videos, **tables, "events.jsonl": FRAMES, "manifest.json": 0}


# --- what happens to it --------------------------------------------------------------------------------------

HARMS: dict[str, Callable[[bytearray, float, float], bytes | None]] = {
    "a bit": lambda data, at, how: _set(data, at, lambda old: old ^ 1 << int(how * 7.99)),
    "a byte": lambda data, at, how: _set(data, at, lambda old: old ^ 1 + int(how * 254.99)),
    "cut": lambda data, at, how: bytes(data[: int(at * len(data))]),
    "zeros": lambda data, at, how: _over(data, at, how, lambda part: bytes(len(part))),
    "backwards": lambda data, at, how: _over(data, at, how, lambda part: part[::-1]),
    "more": lambda data, at, how: bytes(data) + bytes(1 + int(how * 4096)),
    "absent": lambda data, at, how: None,
}


def _set(data: bytearray, at: float, change: Callable[[int], int]) -> bytes:
    place = int(at * (len(data) - 1))
    data[place] = change(data[place])
    return bytes(data)


def _over(data: bytearray, at: float, how: float, change: Callable[[bytes], bytes]) -> bytes:
    first = int(at * (len(data) - 1))
    part = slice(first, first + 1 + int(how * 4096))
    data[part] = change(bytes(data[part]))
    return bytes(data)


@contextmanager
def harmed(path: Path, after: bytes | None) -> Iterator[None]:
    """`path` as a failing disk leaves it, None for gone; whole again afterwards."""
    before = path.read_bytes()
    if after is None:
        path.unlink()
    else:
        path.write_bytes(after)
    try:
        yield
    finally:
        path.write_bytes(before)


def a_bit_off(path: Path) -> bytes:
    return _set(bytearray(path.read_bytes()), 0.5, lambda old: old ^ 8)


NAMES = (
    *("manifest.json", "outcome.json", "sealed.json", "events.jsonl", "cam_high.mp4", "cam_wrist.mp4"),
    *(f"{table}.arrow" for table in SCHEMAS),
)


@pytest.mark.some(6)
@pytest.mark.parametrize("harm", HARMS)
@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=8)
@given(at=st.floats(0, 1), how=st.floats(0, 1))
def test_harm_to_any_file_is_named_and_such_a_recording_is_neither_published_nor_imported_nor_played(
    lab: Path, dataset: Dataset, name: str, harm: str, at: float, how: float
) -> None:
    folder = episode_in(lab)
    if (name, harm) == ("outcome.json", "absent"):
        return  # nothing else is lost: tests/runtime/recording/test_lost.py
    before = (lab / "set/meta/info.json").stat().st_mtime_ns
    whole = (folder / name).read_bytes()
    after = HARMS[harm](bytearray(whole), at, how)
    assume(after != whole)
    with harmed(folder / name, after):
        verdict = verify_episode(folder)
        assert verdict.state == "damaged"
        assert [damage.file for damage in verdict.damage] == [name]
        with pytest.raises(DamagedError, match=name):
            publish(folder, lab / "set", include_interrupted=True)
        with pytest.raises(DamagedError, match=name):
            import_episode(dataset, 0, lab / "episodes", SourceRobot("observation.state"))
        policy = ReplayPolicy(Config(path=str(folder)), robot(), VirtualClock(), 30.0)
        if (name, harm) != (
            "manifest.json",
            "absent",
        ):  # then it is taken for a dataset, which it is not either
            with pytest.raises(PolicyError, match=name):
                policy.connect()
        wanted = ("restored",) if name in ("outcome.json", "sealed.json") else ("damaged", "unreadable")
        assert repair(folder).verdict in wanted
    assert (lab / "set/meta/info.json").stat().st_mtime_ns == before
    assert verify_episode(folder).state == "sound"


@pytest.mark.parametrize("table", SCHEMAS)
def test_the_rows_of_a_damaged_batch_are_named_with_their_times(folder: Path, table: str) -> None:
    path = folder / f"{table}.arrow"
    pieces = [piece.split() for piece in read_outcome(folder)[DIGESTS][path.name]["pieces"]]
    assert len(pieces) >= 5  # header, three batches at least, the end
    whole = path.read_bytes()
    for (begin, first, _), (end, last, _) in pairwise([["0", "0", ""], *pieces]):
        content = bytearray(whole)
        content[(int(begin) + int(end)) // 2] ^= 4
        path.write_bytes(content)
        (damage,) = verify_episode(folder).damage
        if int(last) > int(first):
            assert damage.rows == ((int(first), int(last) - 1),)
            assert damage.text.startswith(f"{path.name} is changed, rows {first} to {int(last) - 1}")
        else:  # of a header that is gone no row can be read; behind the end there is none
            every = 4 * FRAMES if table == "raw" else FRAMES
            assert damage.rows == (((0, every - 1),) if begin == "0" else ())
        if table in ("rows", "ticks"):
            assert damage.times == tuple((one / 30, (other + 1) / 30) for one, other in damage.rows)
    path.write_bytes(whole)
    assert verify_episode(folder).state == "sound"


def test_the_rows_of_a_damaged_stretch_of_a_video_are_named(folder: Path) -> None:
    path = folder / "cam_high.mp4"
    whole = path.read_bytes()
    with av.open(str(path)) as container:
        places = [packet.pos for packet in container.demux(video=0) if packet.size]
    assert len(places) == FRAMES
    for row_of_it, place in enumerate(places):
        content = bytearray(whole)
        content[place + 5] ^= 1
        path.write_bytes(content)
        (damage,) = verify_episode(folder).damage
        ((first, last),) = damage.rows
        assert first <= row_of_it <= last
        assert last - first < 2 * 30  # a second, and the fragment that ends it


def test_damage_far_apart_is_named_apart_and_what_is_cut_off_to_the_end(folder: Path) -> None:
    path = folder / "events.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([b"{}" + lines[0][2:], *lines[1:20]]))
    (damage,) = verify_episode(folder).damage
    assert damage.rows[0][0] == 0
    assert damage.rows[-1][1] == FRAMES - 1
    assert "lines 0 to" in damage.text
    assert "bytes, was recorded with" in damage.text


# --- scrub ---------------------------------------------------------------------------------------------------


def test_a_scrub_says_each_episode_marks_what_is_damaged_and_takes_the_mark_back(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, uuid = folder.parents[1], folder.name
    assert scrubbed(data, capsys) == (0, [verify_episode(folder).to_dict()])
    assert not (data / "quarantine").exists()
    with harmed(folder / "ticks.arrow", a_bit_off(folder / "ticks.arrow")):
        code, (told,) = scrubbed(folder.parent, capsys)
        assert (code, told["state"], told["episode"]) == (1, "damaged", uuid)
        assert marked_damage(data, uuid) == told["damage"]
        mark = (data / f"quarantine/{uuid}.json").read_bytes()
        assert main(["scrub", str(folder)]) == 1
        assert "ticks.arrow is changed, rows" in capsys.readouterr().out
        assert (data / f"quarantine/{uuid}.json").read_bytes() == mark
        assert main(["repair", str(folder)]) == 1
    assert scrubbed(data, capsys)[0] == 0
    assert marked_damage(data, uuid) == []


def test_one_that_cannot_be_scrubbed_keeps_none_of_the_others(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["scrub", str(tmp_path / "absent"), str(folder)]) == 2
    said = capsys.readouterr()
    assert "absent is no folder" in said.err
    assert f"{folder}: sound: every file is as it was recorded" in said.out
    (tmp_path / "empty").mkdir()
    assert main(["scrub", str(tmp_path / "empty")]) == 2


def test_a_mark_that_is_damaged_itself_is_nothing_found_until_the_next_scrub(folder: Path) -> None:
    data, uuid = folder.parents[1], folder.name
    (folder / "raw.arrow").write_bytes(a_bit_off(folder / "raw.arrow"))
    update_mark(verify_episode(folder))
    told = marked_damage(data, uuid)
    assert told
    assert told == verify_episode(folder).to_dict()["damage"]
    mark = data / f"quarantine/{uuid}.json"
    fields = [told[0] | {name: None} for name in told[0]]
    for spoiled in (
        [5],
        [None],
        ["text"],
        [{"file": "raw.arrow"}],
        [told[0] | {"rows": [[1]]}],
        *([one] for one in fields),
    ):
        mark.write_text(json.dumps({"damage": spoiled}), "utf-8")
        assert marked_damage(data, uuid) == []
    update_mark(verify_episode(folder))
    assert marked_damage(data, uuid) == told


def test_one_that_is_closed_to_us_or_cannot_be_marked_keeps_none_of_the_others(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, first = folder.parents[1], folder.with_name("0")
    shutil.copytree(folder, first)
    (first / "outcome.json").unlink()
    (first / "outcome.json").mkdir()
    (folder / "raw.arrow").unlink()
    code, told = scrubbed(data, capsys)
    assert (code, [(one["episode"], one["state"]) for one in told]) == (
        1,
        [("0", "damaged"), (folder.name, "damaged")],
    )
    shutil.rmtree(data / "quarantine")
    (data / "quarantine").write_text("not a folder")
    code, told = scrubbed(data, capsys)
    assert (code, [one["episode"] for one in told]) == (1, ["0", folder.name])
    assert main(["scrub", str(data)]) == 1
    assert capsys.readouterr().err.count("disk error while creating") == 2
    shutil.rmtree(first)
    (folder / "raw.arrow").mkdir()
    assert verify_episode(folder).text == "raw.arrow is a folder"


def test_a_recording_that_lies_elsewhere_is_scrubbed_and_marked_nowhere(folder: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "stick" / folder.name
    shutil.copytree(folder, elsewhere)
    (elsewhere / "raw.arrow").unlink()
    verdict = verify_episode(elsewhere)
    update_mark(verdict)
    assert verdict.text == "raw.arrow is absent"
    assert [path.name for path in (tmp_path / "stick").iterdir()] == [folder.name]


def test_a_disk_that_fails_is_damage_and_a_file_closed_to_us_is_none(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = OSError(errno.EIO, os.strerror(errno.EIO))
    monkeypatch.setattr("runtime.recording.scrub.hashlib.file_digest", Raises(error))
    assert {damage.description for damage in verify_episode(folder).damage} == {
        "cannot be read: the disk fails"
    }
    error.errno = errno.EACCES
    with pytest.raises(RecordingError, match="verifying"):
        verify_episode(folder)


class Raises:
    def __init__(self, error: BaseException) -> None:
        self.error = error

    def __call__(self, *given: object, **named: object) -> object:
        raise self.error


# --- recordings without digests ------------------------------------------------------------------------------


def test_an_older_recording_is_said_to_have_no_digests_and_refused_nowhere(
    folder: Path, dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    unsealed(folder)
    assert scrubbed(folder, capsys)[0] == 0
    assert verify_episode(folder).text == UNSEALED
    assert publish(folder, tmp_path / "one").remark == UNSEALED
    assert datasets(["publish", str(folder), "--to", str(tmp_path / "two")]) == 0
    assert f"remark: {UNSEALED}" in capsys.readouterr().out
    assert import_episode(dataset, 0, folder.parent, SourceRobot("observation.state")) == (folder.name, False)
    policy = ReplayPolicy(Config(path=str(folder)), robot(), VirtualClock(), 30.0)
    assert policy.connect().metadata["files"] == "unsealed"
    assert repair(folder).verdict == "complete"


def test_an_older_recording_that_cannot_be_read_is_damaged_all_the_same(folder: Path) -> None:
    unsealed(folder, frames=FRAMES + 1)
    verdict = verify_episode(folder)
    assert verdict.state == "damaged"
    assert f"{FRAMES} rows readable, its outcome says {FRAMES + 1}" in verdict.text


def test_a_dataset_holds_no_digests_of_a_recording(lab: Path) -> None:
    assert DIGESTS not in (lab / "set/meta/eva_episodes.jsonl").read_text()


# --- killed while files are written anew ---------------------------------------------------------------------


class Killed(BaseException):
    """What no handler of errors sees, as a kill -9 is seen by none."""


@contextmanager
def killed_at(monkeypatch: pytest.MonkeyPatch, number: int) -> Iterator[None]:
    """End this thread at its `number`-th call that makes the disk other, before it happens."""
    calls, ours = itertools.count(), threading.get_ident()
    with monkeypatch.context() as patch:
        for module, name in ((os, "replace"), (os, "fsync"), (os, "link"), (os, "write")):
            real = getattr(module, name)

            def counted(*given: object, real: Callable[..., object] = real) -> object:
                if threading.get_ident() == ours and next(calls) == number:
                    raise Killed
                return real(*given)

            patch.setattr(module, name, counted)
        yield


def outcome_of(folder: Path) -> dict[str, object]:
    outcome = read_outcome(folder)
    return {name: outcome[name] for name in outcome if name not in (DIGESTS, SEAL)}


def test_a_repair_killed_anywhere_leaves_nothing_that_is_called_damaged(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unended(folder)
    for name, torn in (("rows.arrow", 700), ("ticks.arrow", 30), ("cam_high.mp4", 900), ("events.jsonl", 5)):
        with open(folder / name, "r+b") as file:
            file.truncate((folder / name).stat().st_size - torn)
    figures = []
    for number in itertools.count():
        copy = folder.with_name(f"{number}") / folder.name
        shutil.copytree(folder, copy)
        try:
            with killed_at(monkeypatch, number):
                repair(copy)
        except Killed:
            closed, sealed = (copy / "outcome.json").exists(), (copy / "sealed.json").exists()
            assert verify_episode(copy).state == ("sound" if closed else "open")
            assert repair(copy).verdict == ("complete" if closed else "restored" if sealed else "repaired")
            assert verify_episode(copy).state == "sound"
            assert not (copy / PLAN).exists()
            figures.append(outcome_of(copy))
        else:
            break
    assert number > 8
    assert all(one == outcome_of(copy) for one in figures)  # the rows, bytes and lines that were cut, too
    digests = read_outcome(copy)[DIGESTS]
    assert "rows.uncut.arrow" in digests
    assert digests == digests_of(
        copy, Layout.from_manifest(json.loads((folder / "manifest.json").read_text()))
    )


def test_what_a_repair_has_sealed_is_named_when_it_is_damaged(folder: Path) -> None:
    unended(folder)
    assert [report.verdict for report in repair_all(folder.parent)] == ["repaired"]
    video = folder / "cam_wrist.mp4"
    with harmed(video, a_bit_off(video)), pytest.raises(DamagedError, match=r"cam_wrist\.mp4"):
        publish(folder, folder.parents[1] / "set", include_interrupted=True)


def test_an_end_killed_anywhere_leaves_nothing_that_is_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    states = []
    for number in range(100):
        journal = begun(tmp_path / str(number))
        folder = journal.folder
        assert folder is not None
        _flushed(journal, FRAMES)
        try:
            with killed_at(monkeypatch, number):
                journal.end(Outcome("finished", "", 1.7e9))
        except Killed:
            states.append(verify_episode(folder).state)
            continue
        assert verify_episode(folder).state == "sound"
        break
    assert states
    assert set(states) <= {"open", "sound"}


def test_a_recording_that_failed_is_sealed_as_it_lies_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = begun(tmp_path)
    folder = journal.folder
    assert folder is not None
    real = os.write

    def half(descriptor: int, data: bytes) -> int:
        if os.readlink(f"/proc/self/fd/{descriptor}").endswith("ticks.arrow"):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return real(descriptor, data)

    monkeypatch.setattr(os, "write", half)
    journal.append(tick(FRAMES))
    with pytest.raises(RecordingError, match=r"ticks\.arrow"):
        journal.end(Outcome("finished", "", 1.7e9))
    monkeypatch.undo()
    assert verify_episode(folder).state == "sound"
    assert read_outcome(folder)["status"] == "failed"
