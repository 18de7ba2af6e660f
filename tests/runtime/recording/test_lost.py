"""What was changed after it was closed never passes for what was recorded, whatever is lost and whoever mends it."""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from runtime.core.errors import RecordingError
from runtime.datasets.publishing import publish
from runtime.recording.__main__ import main
from runtime.recording.base import Outcome
from runtime.recording.damage_marks import mark_file
from runtime.recording.episode import EpisodeJournal
from runtime.recording.export import write_export
from runtime.recording.files import write_atomic
from runtime.recording.integrity import UNSEALED, DamagedError
from runtime.recording.labels import Label, append_label
from runtime.recording.outcome_seal import OUTCOME, OUTCOME_COPY, read_outcome
from runtime.recording.quarantine import marked_damage, update_mark
from runtime.recording.repair import repair
from runtime.recording.scrub import require_intact, verify_episode
from runtime.recording.tables import SCHEMAS
from tests.examples import some

from .samples import CAMERAS, SETTINGS, chunk, manifest, resealed, row, tick, unended, unsealed

ROWS = 12
SLOW = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]  # on a busy machine


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording that was closed, in no data folder."""
    journal = EpisodeJournal(tmp_path_factory.mktemp("whole"), SETTINGS, patient=True)
    journal.begin(manifest())
    folder = journal.folder
    assert folder is not None
    for k in range(ROWS):
        journal.append(row(k))
        journal.append(tick(k))
        journal.append_event({"kind": "note", "text": str(k)})
    journal.append(chunk(1))
    journal.end(Outcome("finished", "", 1.7e9))
    return folder


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    """The same in a data folder."""
    return Path(shutil.copytree(whole, tmp_path / "data/episodes" / whole.name))


def a_bit_off(path: Path) -> None:
    content = bytearray(path.read_bytes() or b"\0")
    content[len(content) // 2] ^= 8
    path.write_bytes(content)


def half(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def absent(path: Path) -> None:
    path.unlink()


HARMS = (a_bit_off, half, empty, absent)
Harm = Callable[[Path], None]


# --- an outcome that is lost ---------------------------------------------------------------------------------


def test_a_lost_outcome_is_brought_back_where_nothing_else_has_changed(folder: Path) -> None:
    before = (folder / OUTCOME).read_bytes()
    for harm in HARMS:
        harm(folder / OUTCOME)
        report = repair(folder)
        assert (report.verdict, report.frames) == ("restored", ROWS)
        assert OUTCOME in report.problem or "no outcome" in report.problem
        assert (folder / OUTCOME).read_bytes() == before
        harm(folder / OUTCOME_COPY)
        assert [damage.file for damage in verify_episode(folder).damage] == [OUTCOME_COPY]
        assert repair(folder).verdict == "restored"
        assert (folder / OUTCOME_COPY).read_bytes() == before
    assert repair(folder).verdict == "complete"


@pytest.mark.parametrize(
    "name", ["manifest.json", "events.jsonl", f"{CAMERAS[0]}.mp4", "raw.arrow", "rows.arrow"]
)
def test_what_was_changed_is_not_sealed_where_the_outcome_is_lost_too(folder: Path, name: str) -> None:
    (folder / name).write_bytes((folder / name).read_bytes() + b" ")
    (folder / OUTCOME).unlink()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    report = repair(folder)
    assert (report.verdict, {path.name: path.read_bytes() for path in folder.iterdir()}) == (
        "damaged",
        before,
    )
    assert "outcome.json is absent, and was there" in report.problem
    assert f"{name} has " in report.problem


def test_an_outcome_without_its_digests_is_no_older_recording(folder: Path) -> None:
    outcome = json.loads((folder / OUTCOME).read_text())
    (folder / OUTCOME).write_text(
        json.dumps({name: outcome[name] for name in outcome if name not in ("digests", "seal")})
    )
    assert verify_episode(folder).text == "outcome.json has lost its digests: there is sealed.json"
    with pytest.raises(DamagedError):
        require_intact(folder, ("manifest.json",))
    assert repair(folder).verdict == "restored"
    assert json.loads((folder / OUTCOME).read_text()) == outcome


def test_two_outcomes_that_contradict_are_damage_that_nobody_mends(folder: Path) -> None:
    first = (folder / OUTCOME).read_bytes()
    resealed(folder, status="failed")
    (folder / OUTCOME).write_bytes(first)
    assert verify_episode(folder).text == "sealed.json is not the copy of outcome.json that it was"
    assert repair(folder).verdict == "damaged"


def test_of_one_that_was_ended_repair_says_what_nobody_can_say_any_more(folder: Path, tmp_path: Path) -> None:
    log = folder / "events.jsonl"
    log.write_bytes(log.read_bytes().replace(b"note", b"vote"))
    unended(folder)
    report = repair(folder)
    assert (report.verdict, report.rows_cut) == ("repaired", 0)
    assert "all its tables were ended" in report.problem
    assert (verify_episode(folder).state, verify_episode(folder).text) == ("unsealed", report.problem)
    assert report.problem in str(read_outcome(folder)["reason"])
    assert publish(folder, tmp_path / "set", include_interrupted=True).remark == report.problem


def test_of_one_that_was_exported_too(folder: Path) -> None:
    write_export(folder, folder.parents[1])
    unended(folder)
    half(folder / "rows.arrow")
    assert (
        f"exports/stack-the-blocks/continuous/async/{folder.name}.parquet was made of it"
        in repair(folder).problem
    )
    assert verify_episode(folder).state == "unsealed"


# --- marks ---------------------------------------------------------------------------------------------------


def test_a_mark_outlives_the_outcome_and_its_repair(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = folder.parents[1]
    half(folder / "raw.arrow")
    assert main(["scrub", str(data)]) == 1
    mark = marked_damage(data, folder.name)
    unended(folder)
    assert main(["scrub", str(data)]) == 1
    assert main(["repair", str(folder)]) == 1
    assert "raw.arrow has " in capsys.readouterr().out
    assert not (folder / OUTCOME).exists()
    assert marked_damage(data, folder.name) == mark


@pytest.mark.parametrize("spoil", [half, empty])
def test_a_mark_that_is_damaged_itself_keeps_repair_from_sealing(folder: Path, spoil: Harm) -> None:
    data = folder.parents[1]
    half(folder / "raw.arrow")
    update_mark(verify_episode(folder))
    spoil(data / f"quarantine/{folder.name}.json")
    unended(folder)
    assert repair(folder).problem == f"quarantine/{folder.name}.json is no mark any more, and was one"


def test_a_mark_stays_on_what_was_sealed_elsewhere(folder: Path, tmp_path: Path) -> None:
    data = folder.parents[1]
    half(folder / "raw.arrow")
    update_mark(verify_episode(folder))
    mark = marked_damage(data, folder.name)
    for seal in (repair, resealed):
        away = Path(shutil.copytree(folder, tmp_path / seal.__name__))
        unended(away) if seal is repair else None
        seal(away)  # type: ignore[operator]
        shutil.rmtree(folder)
        shutil.move(away, folder)
        assert verify_episode(folder).state == "sound"
        update_mark(verify_episode(folder))
        assert marked_damage(data, folder.name) == mark
        with pytest.raises(DamagedError, match=r"raw\.arrow has"):
            publish(folder, data / "set", include_interrupted=True)
    unsealed(folder)
    update_mark(verify_episode(folder))
    assert marked_damage(data, folder.name) == mark


def test_a_mark_goes_once_the_files_are_back_also_those_of_an_older_recording(
    whole: Path, folder: Path
) -> None:
    data = folder.parents[1]
    for make_old in (False, True):
        unsealed(folder) if make_old else None
        empty(folder / "ticks.arrow")
        update_mark(verify_episode(folder))
        assert marked_damage(data, folder.name)
        shutil.copy(whole / "ticks.arrow", folder)
        update_mark(verify_episode(folder))
        assert marked_damage(data, folder.name) == []


def test_a_mark_that_came_meanwhile_stays(folder: Path) -> None:
    data, before = folder.parents[1], verify_episode(folder)
    half(folder / "raw.arrow")
    update_mark(verify_episode(folder))
    update_mark(before)
    assert marked_damage(data, folder.name)


def test_a_mark_of_an_earlier_version_goes_with_the_files(whole: Path, folder: Path) -> None:
    data = folder.parents[1]
    half(folder / "raw.arrow")
    update_mark(verify_episode(folder))
    path = data / f"quarantine/{folder.name}.json"
    told = json.loads(path.read_text())
    path.write_text(json.dumps({name: told[name] for name in ("uuid", "found", "damage")}))
    unsealed(folder)
    update_mark(verify_episode(folder))
    assert marked_damage(data, folder.name)
    for name in ("raw.arrow", OUTCOME, OUTCOME_COPY):
        shutil.copy(whole / name, folder)
    update_mark(verify_episode(folder))
    assert marked_damage(data, folder.name) == []


def _marks(folder: Path, times: int, failed: Path) -> None:
    try:
        for _ in range(times):
            mark_file(folder.parents[1], folder.name).unlink(missing_ok=True)
            update_mark(verify_episode(folder))
    except (RecordingError, OSError) as error:
        failed.write_text(repr(error))


def test_two_scrubs_at_once_are_in_nobodys_way(folder: Path, tmp_path: Path) -> None:
    half(folder / "raw.arrow")
    workers = [
        multiprocessing.get_context("fork").Process(target=_marks, args=(folder, 20, tmp_path / f"failed{k}"))
        for k in range(3)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert [path.read_text() for path in tmp_path.glob("failed*")] == []
    assert marked_damage(folder.parents[1], folder.name) == verify_episode(folder).to_dict()["damage"]
    assert [path.name for path in (tmp_path / "data/quarantine").iterdir()] == [f"{folder.name}.json"]


def test_a_draft_of_another_writer_is_waited_for_and_one_that_a_kill_left_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / ".a.draft").write_bytes(b"left by a kill, and longer")
    replaced: list[str] = []
    real = os.replace

    def while_another_waits(draft: Path, path: Path) -> None:
        if not replaced:
            replaced.append("first")
            # Not forked: a child would have a copy of our lock, and wait for itself.
            other = multiprocessing.get_context("spawn").Process(target=write_atomic, args=(path, b"second"))
            other.start()
            replaced.append(str(other.pid))
            real(draft, path)
        else:
            real(draft, path)

    monkeypatch.setattr(os, "replace", while_another_waits)
    write_atomic(tmp_path / "a", b"first")
    os.waitpid(int(replaced[1]), 0)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a", b"second")]


# --- recordings without digests ------------------------------------------------------------------------------


@pytest.mark.parametrize("harm", [half, empty, absent])
@pytest.mark.parametrize(
    "name", [*(f"{table}.arrow" for table in SCHEMAS), f"{CAMERAS[0]}.mp4", "events.jsonl"]
)
def test_what_is_torn_or_absent_of_an_older_recording_is_named(folder: Path, name: str, harm: Harm) -> None:
    unsealed(folder)
    assert verify_episode(folder).text == UNSEALED
    harm(folder / name)
    if (name, harm) == ("events.jsonl", empty):
        return  # one in which nothing happened is no other
    verdict = verify_episode(folder)
    assert verdict.state == "damaged"
    assert name in verdict.text
    assert "torn" in verdict.text or "absent" in verdict.text or "rows readable" in verdict.text
    with pytest.raises(DamagedError, match=name):
        publish(folder, folder.parents[1] / "set")


def test_an_older_recording_that_failed_may_end_anywhere(folder: Path) -> None:
    unsealed(folder, status="failed")
    half(folder / "raw.arrow")
    assert verify_episode(folder).state == "unsealed"


# --- any sequence --------------------------------------------------------------------------------------------


FILES = (
    "manifest.json",
    "events.jsonl",
    *(f"{camera}.mp4" for camera in CAMERAS),
    *(f"{table}.arrow" for table in SCHEMAS),
)
STEPS = (
    *("scrub", "repair", "killed repair", "repair elsewhere", "label", "export"),
    *("lose outcome", "lose copy", "back", "harm", "spoil mark"),
)


class Killed(BaseException):
    """What no handler of errors sees."""


class Lab:
    """A recording of a data folder, and what happens to it.

    Its outcome is not taken away where neither the copy of that nor a mark would be left.
    """

    def __init__(self, whole: Path, data: Path) -> None:
        shutil.rmtree(data, ignore_errors=True)
        self.whole, self.data = whole, data
        self.folder = Path(shutil.copytree(whole, data / "episodes" / whole.name))
        self.mark = data / f"quarantine/{whole.name}.json"
        self.known = (
            True  # whether its own outcome is kept anywhere: with the last of it a mark may name another one
        )

    def step(self, kind: str, name: str, harm: Harm, number: int) -> None:
        if kind == "scrub":
            update_mark(verify_episode(self.folder))
        elif kind == "repair":
            repair(self.folder)
        elif kind == "killed repair":
            self._killed_repair(number)
        elif kind == "label":
            append_label(self.data, self.folder.name, Label(1.0, "ann", "success"))
        elif kind == "export":
            self._export()
        elif kind == "back":
            shutil.copytree(self.whole, self.folder, dirs_exist_ok=True)
        elif kind == "repair elsewhere":
            away = Path(shutil.move(self.folder, self.data))
            repair(away)
            shutil.move(away, self.folder)
        elif kind == "lose outcome" and ((self.folder / OUTCOME_COPY).exists() or self.mark.exists()):
            (self.folder / OUTCOME).unlink(missing_ok=True)
        elif kind == "lose copy" and ((self.folder / OUTCOME).exists() or self.mark.exists()):
            (self.folder / OUTCOME_COPY).unlink(missing_ok=True)
        elif kind == "harm" and (self.folder / name).exists():
            harm(self.folder / name)
        elif kind == "spoil mark" and self.mark.exists():
            self.known &= self.told
            empty(self.mark)

    def _killed_repair(self, number: int) -> None:
        calls = itertools.count()

        def counted(real: Callable[..., object]) -> Callable[..., object]:
            def call(*given: object, **named: object) -> object:
                if next(calls) == number:
                    raise Killed
                return real(*given, **named)

            return call

        with pytest.MonkeyPatch.context() as patch:
            for call in ("replace", "fsync", "link", "unlink"):
                patch.setattr(os, call, counted(getattr(os, call)))
            try:
                repair(self.folder)
            except Killed:
                return

    def _export(self) -> None:
        try:
            write_export(self.folder, self.data)
        except RecordingError:
            return

    @property
    def changed(self) -> bool:
        return any(
            not (self.folder / name).exists()
            or (self.folder / name).read_bytes() != (self.whole / name).read_bytes()
            for name in FILES
        )

    @property
    def told(self) -> bool:
        """Whether one of its own outcomes is there."""
        seal = (self.whole / OUTCOME).read_bytes()
        there = [self.folder / name for name in (OUTCOME, OUTCOME_COPY) if (self.folder / name).exists()]
        return bool(there) and all(path.read_bytes() == seal for path in there)

    @property
    def passes(self) -> bool:
        """Whether it would be taken for what was recorded."""
        update_mark(verify_episode(self.folder))
        return verify_episode(self.folder).state == "sound" and not self.mark.exists()


BEGINNINGS = (
    (),
    ("harm",),
    ("harm", "lose outcome"),
    ("harm", "scrub", "lose outcome", "lose copy"),
    ("harm", "scrub", "lose outcome", "lose copy", "repair elsewhere"),
)


@given(
    beginning=st.sampled_from(BEGINNINGS),
    kinds=st.lists(st.sampled_from(STEPS), max_size=8),
    how=st.tuples(st.sampled_from(FILES), st.sampled_from(HARMS), st.integers(0, 12)),
)
@example(
    beginning=BEGINNINGS[-1], kinds=("lose copy", "spoil mark", "scrub", "back"), how=(FILES[1], a_bit_off, 0)
)
@settings(max_examples=some(80), suppress_health_check=SLOW)
def test_no_sequence_ends_with_changed_bytes_that_pass_for_what_was_recorded(
    whole: Path, tmp_path: Path, beginning: Sequence[str], kinds: Sequence[str], how: tuple[str, Harm, int]
) -> None:
    lab = Lab(whole, tmp_path / "data")
    for kind in (*beginning, *kinds):
        lab.step(kind, *how)
    assert not (lab.changed and lab.passes)
    if not lab.changed and lab.told and lab.known:
        repair(lab.folder)
        assert lab.passes
        assert (lab.folder / OUTCOME).read_bytes() == (whole / OUTCOME).read_bytes()


@given(name=st.sampled_from([*FILES[1:4]]), at=st.floats(0, 1), bit=st.integers(0, 7))
@example(name=FILES[2], at=0.0078125, bit=7)  # a name in its metadata is no UTF-8 then
@settings(max_examples=some(20), suppress_health_check=SLOW)
def test_nor_where_both_outcomes_are_lost_as_long_as_its_tables_have_their_ends(
    whole: Path, tmp_path: Path, name: str, at: float, bit: int
) -> None:
    lab = Lab(whole, tmp_path / "data")
    content = bytearray((lab.folder / name).read_bytes())
    content[int(at * (len(content) - 1))] ^= 1 << bit
    (lab.folder / name).write_bytes(content)
    unended(lab.folder)
    assert repair(lab.folder).verdict == "repaired"
    assert verify_episode(lab.folder).state == "unsealed"
