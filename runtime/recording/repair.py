"""Completion of an episode whose recorder was killed: cut torn ends, equalise lengths, write an outcome."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from runtime.core.durable_files import sync_folder
from runtime.core.errors import RecordingError
from runtime.recording.archive_index import require_not_stored
from runtime.recording.base import VIDEO_LOST
from runtime.recording.damage_marks import data_of
from runtime.recording.episode import lock_folder
from runtime.recording.export import export_path
from runtime.recording.files import disk_error, read_json, to_json, write_atomic
from runtime.recording.fragments import count_frames, whole_bytes
from runtime.recording.integrity import IntegrityCheck
from runtime.recording.layout import Layout
from runtime.recording.outcome_seal import (
    MANIFEST,
    OUTCOME,
    OUTCOME_COPY,
    SEAL,
    digests_of,
    read_outcome,
    seal_outcome,
    write_outcome,
)
from runtime.recording.reader import read_events
from runtime.recording.scrub import verify_episode
from runtime.recording.summary import summarise
from runtime.recording.tables import SCHEMAS, read_table, write_table

REASON = "the recorder ended without closing the episode"
UNCUT = "rows.uncut.arrow"  # rows as they were found, if some were cut
PLAN = ".repair.json"  # state of the episode before its repair, while that is under way
UNPROVABLE = "its outcome is lost, and with it whether its files are as they were recorded"


@dataclass(frozen=True, slots=True)
class RepairReport:
    """Findings and actions of the repair of an episode.

    `verdict` is one of these:

        "complete": the episode has an outcome; nothing was done.
        "restored": the episode's outcome was restored from its copy; `problem` is the damage that the outcome
            had.
        "damaged": the episode's files do not match its outcome (`problem`); this cannot be mended, and nothing
            was done.
        "repaired": the repair has written an outcome. If the episode had been closed before, `problem` names
            the facts about its end that are lost.
        "recording": the episode is being written; nothing was done.
        "unreadable": the episode has no usable manifest; nothing was done.
        "failed": the repair was stopped by `problem`.
    """

    path: Path
    verdict: Literal["complete", "restored", "damaged", "repaired", "recording", "unreadable", "failed"]
    problem: str = ""
    frames: int = 0  # rows with a frame in every video
    rows_cut: int = 0  # whole rows without a frame in every video
    video_frames: Mapping[str, int] = field(default_factory=dict)
    torn_bytes: int = 0  # bytes cut from tables and videos
    torn_lines: int = 0  # lines cut from the events
    lost: Mapping[str, str] = field(
        default_factory=dict
    )  # cameras whose video had ended before, with the reason


def repair(path: Path) -> RepairReport:
    """Complete the episode in folder `path` if it has no outcome; running it again changes nothing.

    If the outcome of an episode is lost but was written before, the outcome is restored from its copy, provided that
    the episode's files match it. If they do not match, or if the episode is marked as damaged, the episode is left
    alone: changed files are never sealed as if they had been recorded.

    Rows without a frame in every video are cut. Cameras whose video had ended before do not count for this. The table
    as found stays as rows.uncut.arrow. Videos are never re-encoded: only a torn fragment at their end is cut.

    Raises RecordingError if the disk fails.
    """
    if not path.is_dir():
        raise RecordingError(f"{path} is no folder of an episode")
    descriptor = lock_folder(path)
    if descriptor is None:
        return RepairReport(path, "recording", "it is being written right now")
    try:
        return _judge(path)
    except OSError as error:
        raise disk_error("repairing", path, error) from error
    finally:
        os.close(descriptor)


def repair_all(root: Path) -> list[RepairReport]:
    """Repair every episode in `root` without an outcome; an episode that fails does not stop the rest."""
    folders = [folder for folder in sorted(root.iterdir()) if folder.is_dir()] if root.is_dir() else []
    return [_attempt(folder) for folder in folders if not (folder / OUTCOME).exists()]


def _attempt(folder: Path) -> RepairReport:
    try:
        return repair(folder)
    except RecordingError as error:
        return RepairReport(folder, "failed", str(error))


def _judge(path: Path) -> RepairReport:
    try:
        layout = Layout.from_manifest(read_json(path / MANIFEST))
        check = verify_episode(path)
        if check.state != "open" or (path / OUTCOME_COPY).exists():
            return _closed(path, check)
        for camera in layout.cameras:
            # Without a video that is in the lab's store, every row would be cut.
            if not (video := path / f"{camera}.mp4").exists():
                require_not_stored(video)
    except RecordingError as error:
        return RepairReport(path, "unreadable", str(error))
    return _complete(path, layout)


def _closed(path: Path, check: IntegrityCheck) -> RepairReport:
    """Restore outcome.json or its copy, if one is missing or damaged, from the intact file; change no other file.

    This is done only if all other files match their digests. Return the report.
    """
    restored = ""
    if check.state in ("open", "damaged") and (whole := _whole_outcome(path, check)):
        write_outcome(path, whole)
        restored, check = check.text, verify_episode(path)
    if check.state == "damaged":
        return RepairReport(path, "damaged", check.text)
    (path / PLAN).unlink(missing_ok=True)
    frames = read_outcome(path).get("frames")
    verdict: Literal["restored", "complete"] = "restored" if restored else "complete"
    return RepairReport(path, verdict, restored, frames=frames if isinstance(frames, int) else 0)


def _whole_outcome(path: Path, check: IntegrityCheck) -> bytes | None:
    """Return the content of the only intact outcome file, outcome.json or its copy.

    None unless exactly one of them is intact and no other file is damaged.
    """
    if {damage.file for damage in check.damage} - {OUTCOME, OUTCOME_COPY}:
        return None
    whole = {}
    for name in (OUTCOME, OUTCOME_COPY):
        try:
            if SEAL in read_outcome(path, name):
                whole[name] = (path / name).read_bytes()
        except RecordingError:
            continue
    return next(iter(whole.values())) if len(whole) == 1 else None


def _complete(path: Path, layout: Layout) -> RepairReport:
    measured = _load_or_measure(path, layout)
    videos = _repair_videos(path, layout)
    lost = _repair_events(path)
    going = [frames for camera, frames in videos.items() if camera not in lost]
    frames = _repair_tables(path, layout, going)
    cut = measured.rows - frames
    report = RepairReport(
        path,
        "repaired",
        measured.unproven,
        frames,
        cut,
        videos,
        measured.torn_bytes,
        measured.torn_lines,
        lost,
    )
    write_outcome(path, seal_outcome(_outcome(report, layout, measured.ended), digests_of(path, layout)))
    (path / PLAN).unlink()  # last: a repair that is killed before continues from the stored state
    return report


@dataclass(frozen=True, slots=True)
class _FolderState:
    """State of an episode's folder before its repair, stored so that a repair can continue after a kill."""

    ended: float  # time of its last write [Unix s]
    rows: int
    torn_bytes: int
    torn_lines: int
    unproven: str  # facts that can no longer be proven


def _load_or_measure(path: Path, layout: Layout) -> _FolderState:
    """Return the folder's state that an earlier attempt stored; if there is none, measure and store it now."""
    plan = path / PLAN
    if plan.exists():
        try:
            return _FolderState(**read_json(plan))  # type: ignore[arg-type]
        except TypeError as error:
            raise RecordingError(f"{plan} is none of repair's: {error}. Remove it") from error
    measured = _measured(path, layout)
    write_atomic(plan, to_json(asdict(measured), "the plan of a repair"))
    return measured


def _measured(path: Path, layout: Layout) -> _FolderState:
    ended = max(file.stat().st_mtime for file in path.iterdir() if not file.name.startswith("."))  # no drafts
    tables = [read_table(path / f"{name}.arrow", schema(layout)) for name, schema in SCHEMAS.items()]
    torn = sum(_torn(path / f"{camera}.mp4") for camera in layout.cameras)
    torn += sum(table.torn_bytes for table in tables)
    rows = tables[list(SCHEMAS).index("rows")].table.num_rows
    closed = all(table.closed for table in tables)
    return _FolderState(ended, rows, torn, read_events(path / "events.jsonl").torn, _unproven(path, closed))


def _unproven(path: Path, closed: bool) -> str:
    """Return a sentence if the episode had been closed before, so that facts about its end are lost; "" if not.

    The episode had been closed if there is an export of it, or if `closed` is True, which states that all its tables
    have an end mark.
    """
    data = data_of(path)
    table = export_path(read_json(path / MANIFEST), data) if data else None
    if table is not None and table.exists():
        return f"{UNPROVABLE}: it was closed, for {table} was made of it"
    return f"{UNPROVABLE}: all its tables were ended, which is done when it is closed" if closed else ""


def _torn(video: Path) -> int:
    """Return the number of bytes after the last whole fragment."""
    end = whole_bytes(video) if video.exists() else 0
    return video.stat().st_size - end if end else 0


def _repair_videos(path: Path, layout: Layout) -> dict[str, int]:
    """Cut torn ends of the videos; return the number of frames per camera."""
    frames = {}
    for camera in layout.cameras:
        video = path / f"{camera}.mp4"
        if torn := _torn(video):
            with open(video, "r+b") as file:
                file.truncate(video.stat().st_size - torn)
                os.fsync(file.fileno())
        frames[camera] = count_frames(video) if video.exists() else 0
    return frames


def _repair_tables(path: Path, layout: Layout, videos: Sequence[int]) -> int:
    """Cut the rows to the frame count of the shortest of `videos`, and close all tables; return the common count."""
    frames = 0
    for name, schema in SCHEMAS.items():
        file = path / f"{name}.arrow"
        read = read_table(file, schema(layout))
        table = read.table
        if name == "rows":
            frames = min([table.num_rows, *videos])
            table = table.slice(0, frames)
        cut = read.table.num_rows - table.num_rows
        if cut:
            _keep_uncut(path)
        if cut or not read.closed:
            write_table(file, table)
    return frames


def _keep_uncut(path: Path) -> None:
    if not (path / UNCUT).exists():
        os.link(path / "rows.arrow", path / UNCUT)
        sync_folder(path)


def _repair_events(path: Path) -> dict[str, str]:
    """Remove torn lines; return the cameras whose video had ended, with the recorded reason."""
    log = path / "events.jsonl"
    events = read_events(log)
    if events.torn or not log.exists():
        write_atomic(log, b"".join(line + b"\n" for line in events.lines))
    recorded = [json.loads(line) for line in events.lines]
    return {
        str(event["data"]["camera"]): str(event["text"])
        for event in recorded
        if event.get("kind") == VIDEO_LOST
    }


def _outcome(report: RepairReport, layout: Layout, ended: float) -> dict[str, object]:
    summary = summarise(report.path / "rows.arrow", layout, report.frames)
    return {
        "status": "interrupted",
        "reason": f"{REASON}; {report.frames} rows kept, {report.rows_cut} without a frame cut"
        + (f"; {report.problem}" if report.problem else ""),
        "ended_wall": ended,
        **summary.to_dict(),
        "rows": report.frames,
        "video_frames": dict(report.video_frames),
        "lost_cameras": {
            camera: {"row": report.video_frames[camera], "reason": reason}
            for camera, reason in report.lost.items()
        },
        "repair": {
            "rows_cut": report.rows_cut,
            "torn_bytes": report.torn_bytes,
            "torn_lines": report.torn_lines,
            **({"unproven": report.problem} if report.problem else {}),
        },
    }
