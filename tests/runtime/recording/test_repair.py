import shutil
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from runtime.core.errors import RecordingError
from runtime.recording import repair as repair_module
from runtime.recording.archive_index import write_index
from runtime.recording.base import Outcome
from runtime.recording.episode import EpisodeJournal
from runtime.recording.export import write_export
from runtime.recording.layout import Layout
from runtime.recording.reader import open_episode
from runtime.recording.repair import UNCUT, repair, repair_all
from runtime.recording.tables import SCHEMAS, read_table
from tests.examples import some

from .samples import CAMERAS, SETTINGS, chunk, manifest, numbers, row, tick, unended
from .test_tables import old_raw

ROWS = 40


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole episode that lacks its outcome."""
    journal = EpisodeJournal(
        tmp_path_factory.mktemp("template"), SETTINGS.model_copy(update={"flush_period_s": 0.01})
    )
    journal.begin(manifest())
    folder = journal.folder
    assert folder is not None
    for k in range(ROWS):
        journal.append(row(k, control_source="none" if k < 10 else "policy"))
        journal.append(tick(k))
        journal.append_event({"row": k})
    journal.append(chunk(1))
    journal.end(Outcome("finished", "", 1.7e9))
    unended(folder)
    return folder


@pytest.fixture
def folder(unfinished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(unfinished, tmp_path / unfinished.name))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def cut(path: Path, size: int) -> None:
    with open(path, "r+b") as file:
        file.truncate(size)


def test_no_row_is_cut_because_the_videos_are_in_the_store(unfinished: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(unfinished, tmp_path / "episodes" / unfinished.name))
    videos = [folder / f"{camera}.mp4" for camera in CAMERAS]
    write_index(tmp_path, folder.name, {video.name: "ab" * 32 for video in videos})
    for video in videos:
        video.unlink()
    before = contents(folder)
    report = repair(folder)
    assert (report.verdict, f"archive --back {folder.name}" in report.problem) == ("unreadable", True)
    assert contents(folder) == before


def test_an_episode_that_only_lacks_its_outcome_loses_nothing(folder: Path) -> None:
    newest = max(path.stat().st_mtime for path in folder.iterdir())
    before = contents(folder)
    report = repair(folder)
    assert (report.verdict, report.frames, report.rows_cut, report.torn_bytes) == ("repaired", ROWS, 0, 0)
    assert report.video_frames == dict.fromkeys(CAMERAS, ROWS)
    after = contents(folder)
    assert after.pop("outcome.json") == after.pop("sealed.json")
    assert after == before
    outcome = open_episode(folder).outcome
    assert outcome is not None
    assert outcome["status"] == "interrupted"
    assert "ended without closing" in str(outcome["reason"])
    assert outcome["ended_wall"] == newest
    assert (outcome["frames"], outcome["held_rows"], outcome["duration_s"]) == (ROWS, 10, pytest.approx(1.0))


def test_rows_without_a_frame_are_cut_and_kept_beside(folder: Path) -> None:
    video = folder / f"{CAMERAS[1]}.mp4"
    before = (folder / "rows.arrow").read_bytes()
    cut(video, video.stat().st_size // 2)
    report = repair(folder)
    assert 0 < report.frames < ROWS
    assert report.rows_cut == ROWS - report.frames
    assert report.torn_bytes > 0
    episode = open_episode(folder)
    assert episode.rows.column("index").to_pylist() == list(range(report.frames))
    assert numbers(video) == list(range(1, report.frames + 1))
    assert numbers(episode.videos[CAMERAS[0]]) == list(range(1, ROWS + 1))
    assert (folder / UNCUT).read_bytes() == before
    assert read_table(folder / "rows.arrow", SCHEMAS["rows"](episode.layout)).closed
    assert episode.ticks.num_rows == ROWS


def test_videos_with_more_frames_than_rows_are_kept(folder: Path) -> None:
    rows = folder / "rows.arrow"
    videos = {camera: (folder / f"{camera}.mp4").read_bytes() for camera in CAMERAS}
    cut(rows, rows.stat().st_size - 40)
    report = repair(folder)
    assert report.frames < ROWS
    assert report.video_frames == dict.fromkeys(CAMERAS, ROWS)
    assert {camera: (folder / f"{camera}.mp4").read_bytes() for camera in CAMERAS} == videos
    assert not (folder / UNCUT).exists()
    assert open_episode(folder).frames == report.frames


def test_half_a_line_of_the_events_is_dropped(folder: Path) -> None:
    log = folder / "events.jsonl"
    cut(log, log.stat().st_size - 4)
    report = repair(folder)
    assert report.torn_lines == 1
    assert open_episode(folder).events == tuple({"row": k} for k in range(ROWS - 1))


def test_repairing_again_changes_nothing(folder: Path) -> None:
    cut(folder / "rows.arrow", 5000)
    first = repair(folder)
    before = contents(folder)
    second = repair(folder)
    assert (second.verdict, second.frames) == ("complete", first.frames)
    assert contents(folder) == before


def test_a_repair_that_was_itself_killed_is_completed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video = folder / f"{CAMERAS[0]}.mp4"
    rows = (folder / "rows.arrow").read_bytes()
    cut(video, video.stat().st_size // 2)

    def killed(folder: Path, text: bytes) -> None:
        raise RecordingError("killed")

    monkeypatch.setattr(repair_module, "write_outcome", killed)
    with pytest.raises(RecordingError, match="killed"):
        repair(folder)
    monkeypatch.undo()
    report = repair(folder)
    assert (report.verdict, report.rows_cut) == ("repaired", ROWS - report.frames)
    assert report.rows_cut > 0
    assert report.torn_bytes > 0
    assert open_episode(folder).frames == report.frames
    assert (folder / UNCUT).read_bytes() == rows


@given(data=st.data())
@settings(max_examples=some(40), suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_is_torn_rows_and_frames_belong_together_afterwards(
    unfinished: Path, tmp_path: Path, data: st.DataObject
) -> None:
    folder = tmp_path / "torn" / unfinished.name
    shutil.rmtree(folder.parent, ignore_errors=True)
    shutil.copytree(unfinished, folder)
    for path in sorted(folder.iterdir()):
        if path.name != "manifest.json" and data.draw(st.booleans(), label=path.name):
            cut(path, data.draw(st.integers(0, path.stat().st_size)))
    report = repair(folder)
    assert report.verdict == "repaired"
    episode = open_episode(folder)
    assert episode.frames == report.frames == episode.rows.num_rows
    assert episode.frames == min([report.frames + report.rows_cut, *report.video_frames.values()])
    for camera, video in episode.videos.items():
        assert report.video_frames[camera] >= report.frames
        if report.frames:
            assert numbers(video)[: report.frames] == list(range(1, report.frames + 1))
    assert len(episode.events) <= ROWS


def test_missing_files_are_made_good_as_empty_ones(folder: Path) -> None:
    for name in ("ticks.arrow", "events.jsonl", f"{CAMERAS[0]}.mp4"):
        (folder / name).unlink()
    report = repair(folder)
    assert (report.verdict, report.frames, report.rows_cut) == ("repaired", 0, ROWS)
    layout = Layout.from_manifest(manifest())
    assert read_table(folder / "ticks.arrow", SCHEMAS["ticks"](layout)).closed
    assert (folder / "events.jsonl").read_bytes() == b""


@pytest.mark.parametrize("torn", [b"", b'{"uuid": "abc', b"{}"])
def test_a_torn_manifest_is_reported_and_nothing_is_touched(tmp_path: Path, torn: bytes) -> None:
    folder = tmp_path / "episode"
    folder.mkdir()
    (folder / "manifest.json").write_bytes(torn)
    before = contents(folder)
    report = repair(folder)
    assert report.verdict == "unreadable"
    assert "manifest" in report.problem
    assert contents(folder) == before


def test_an_empty_folder_is_reported_and_stays_empty(tmp_path: Path) -> None:
    assert repair(tmp_path).verdict == "unreadable"
    assert list(tmp_path.iterdir()) == []


def test_an_episode_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    journal = EpisodeJournal(tmp_path, SETTINGS)
    journal.begin(manifest())
    assert journal.folder is not None
    folder = journal.folder
    journal.append(row(0))
    assert repair(folder).verdict == "recording"
    assert not (folder / "outcome.json").exists()
    journal.append(row(1))
    journal.end(Outcome("finished", "", 1.7e9))
    assert repair(folder).verdict == "complete"
    assert open_episode(folder).frames == 2


def test_a_path_that_is_no_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no folder"):
        repair(tmp_path / "absent")


def test_all_unfinished_episodes_are_repaired_and_one_bad_one_keeps_nobody(
    unfinished: Path, tmp_path: Path
) -> None:
    for name in ("a", "b", "c"):
        shutil.copytree(unfinished, tmp_path / name)
    repair(tmp_path / "a")
    (tmp_path / "b" / "rows.arrow").unlink()
    (tmp_path / "b" / "rows.arrow").mkdir()
    (tmp_path / "d").mkdir()
    (tmp_path / "notes.txt").write_text("not an episode")
    reports = {report.path.name: report for report in repair_all(tmp_path)}
    assert {name: report.verdict for name, report in reports.items()} == {
        "b": "failed",
        "c": "repaired",
        "d": "unreadable",
    }
    assert "rows.arrow" in reports["b"].problem
    assert repair_all(tmp_path / "absent") == []


def test_an_episode_from_before_strategies_were_written_down_is_repaired_and_opens(folder: Path) -> None:
    whole = old_raw(folder / "raw.arrow")
    cut(folder / "raw.arrow", len(whole) - 40)
    assert repair(folder).verdict == "repaired"
    raw = open_episode(folder).raw
    assert raw["index"].to_pylist() == [0, 1]
    assert raw["strategy"].to_pylist() == [None, None]
    assert read_table(folder / "raw.arrow", SCHEMAS["raw"](open_episode(folder).layout)).closed
    assert write_export(folder, folder.parent).is_file()
