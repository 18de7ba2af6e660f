"""Completes an episode whose recorder was killed: cuts torn tails, makes lengths equal, writes an outcome."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from runtime.core.errors import RecordingError
from runtime.recording.base import VIDEO_LOST
from runtime.recording.episode import lock_folder
from runtime.recording.export import export_path
from runtime.recording.files import disk_error, read_json, sync_folder, to_json, write_atomic
from runtime.recording.fragments import count_frames, whole_bytes
from runtime.recording.layout import Layout
from runtime.recording.marks import data_of
from runtime.recording.reader import read_events
from runtime.recording.scrub import verify_episode
from runtime.recording.sealing import (
    MANIFEST,
    OUTCOME,
    OUTCOME_COPY,
    SEAL,
    digests_of,
    read_outcome,
    seal_outcome,
    write_outcome,
)
from runtime.recording.summary import summarise
from runtime.recording.tables import SCHEMAS, read_table, write_table
from runtime.recording.verdict import IntegrityCheck

REASON = "the recorder ended without closing the episode"
UNCUT = "rows.uncut.arrow"  # the rows as they were found, where any had to go
PLAN = ".repair.json"  # how the episode was found, as long as its repair is under way
UNPROVABLE = "its outcome is lost, and with it whether its files are as they were recorded"


@dataclass(frozen=True, slots=True)
class RepairReport:
    """Findings and actions of a repair.

    "complete": had an outcome, nothing done. "restored": has its outcome back from its copy; `problem` is
    what had become of it. "damaged": had one, and `problem` is what is not as it was recorded; nothing done,
    it cannot be mended. "repaired": has one now; `problem` is what cannot be known any more of one that had
    been closed before. "recording": is being written right now, nothing done. "unreadable": no manifest to go
    by, nothing done. "failed": `problem` stopped it.
    """

    path: Path
    verdict: Literal["complete", "restored", "damaged", "repaired", "recording", "unreadable", "failed"]
    problem: str = ""
    frames: int = 0  # rows that have a frame in every video
    rows_cut: int = 0  # whole rows without a frame in every video
    video_frames: Mapping[str, int] = field(default_factory=dict)
    torn_bytes: int = 0  # cut from the tables and videos
    torn_lines: int = 0  # cut from the events
    lost: Mapping[str, str] = field(default_factory=dict)  # cameras whose video had ended before, and why


def repair(path: Path) -> RepairReport:
    """Complete the episode in folder `path` where it has no outcome; running it again changes nothing.

    One that had an outcome gets that back from its copy, where its files are as that says, and is left alone where they
    are not, or where it is marked as damaged: what was changed is never sealed as what was recorded.

    Rows without a frame in every video are cut, but for cameras whose video had ended before; the table as found stays
    beside as rows.uncut.arrow. Videos are never re-encoded: only a torn fragment at their end is cut. RecordingError
    where the disk fails.
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
    """Repair every episode in `root` that has no outcome; one that fails does not keep the others."""
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
        found = verify_episode(path)
        if found.state != "open" or (path / OUTCOME_COPY).exists():
            return _closed(path, found)
    except RecordingError as error:
        return RepairReport(path, "unreadable", str(error))
    return _complete(path, layout)


def _closed(path: Path, found: IntegrityCheck) -> RepairReport:
    """Nothing is mended but the outcome, from its copy, or that copy, where all other files are as they say."""
    restored = ""
    if found.state in ("open", "damaged") and (whole := _whole_outcome(path, found)):
        write_outcome(path, whole)
        restored, found = found.text, verify_episode(path)
    if found.state == "damaged":
        return RepairReport(path, "damaged", found.text)
    (path / PLAN).unlink(missing_ok=True)
    frames = read_outcome(path).get("frames")
    verdict: Literal["restored", "complete"] = "restored" if restored else "complete"
    return RepairReport(path, verdict, restored, frames=frames if isinstance(frames, int) else 0)


def _whole_outcome(path: Path, found: IntegrityCheck) -> bytes | None:
    """The one of its two files that is as it was sealed, where nothing but the other one is damaged; None else."""
    if {one.file for one in found.damage} - {OUTCOME, OUTCOME_COPY}:
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
    found = _load_or_measure(path, layout)
    videos = _repair_videos(path, layout)
    lost = _repair_events(path)
    going = [frames for camera, frames in videos.items() if camera not in lost]
    frames = _repair_tables(path, layout, going)
    cut = found.rows - frames
    report = RepairReport(
        path, "repaired", found.unproven, frames, cut, videos, found.torn_bytes, found.torn_lines, lost
    )
    write_outcome(path, seal_outcome(_outcome(report, layout, found.ended), digests_of(path, layout)))
    (path / PLAN).unlink()
    return report


@dataclass(frozen=True, slots=True)
class _FolderState:
    """The episode as it lay there before anything was mended, for who goes on where a repair was killed."""

    ended: float  # when it was last written [Unix s]
    rows: int
    torn_bytes: int
    torn_lines: int
    unproven: str  # what nobody can say of it any more


def _load_or_measure(path: Path, layout: Layout) -> _FolderState:
    """As an earlier attempt wrote it down, else measured and written down now."""
    plan = path / PLAN
    if plan.exists():
        try:
            return _FolderState(**read_json(plan))  # type: ignore[arg-type]
        except TypeError as error:
            raise RecordingError(f"{plan} is none of repair's: {error}. Remove it") from error
    found = _measured(path, layout)
    write_atomic(plan, to_json(asdict(found), "the plan of a repair"))
    return found


def _measured(path: Path, layout: Layout) -> _FolderState:
    ended = max(file.stat().st_mtime for file in path.iterdir() if not file.name.startswith("."))  # no drafts
    tables = [read_table(path / f"{name}.arrow", schema(layout)) for name, schema in SCHEMAS.items()]
    torn = sum(_torn(path / f"{camera}.mp4") for camera in layout.cameras)
    torn += sum(table.torn_bytes for table in tables)
    rows = tables[list(SCHEMAS).index("rows")].table.num_rows
    closed = all(table.closed for table in tables)
    return _FolderState(ended, rows, torn, read_events(path / "events.jsonl").torn, _unproven(path, closed))


def _unproven(path: Path, closed: bool) -> str:
    """Facts that cannot be known any more of an episode once closed, "" where nothing tells that it was."""
    data = data_of(path)
    table = export_path(read_json(path / MANIFEST), data) if data else None
    if table is not None and table.exists():
        return f"{UNPROVABLE}: it was closed, for {table} was made of it"
    return f"{UNPROVABLE}: all its tables were ended, which is done when it is closed" if closed else ""


def _torn(video: Path) -> int:
    """Bytes behind the last whole fragment."""
    end = whole_bytes(video) if video.exists() else 0
    return video.stat().st_size - end if end else 0


def _repair_videos(path: Path, layout: Layout) -> dict[str, int]:
    """Frames per camera."""
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
    """Common number of rows and frames in videos of so many."""
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
    """The cameras whose video had ended, with what was said of it."""
    log = path / "events.jsonl"
    events = read_events(log)
    if events.torn or not log.exists():
        write_atomic(log, b"".join(line + b"\n" for line in events.lines))
    said = [json.loads(line) for line in events.lines]
    return {
        str(event["data"]["camera"]): str(event["text"]) for event in said if event.get("kind") == VIDEO_LOST
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
            camera: {"row": report.video_frames[camera], "reason": why} for camera, why in report.lost.items()
        },
        "repair": {
            "rows_cut": report.rows_cut,
            "torn_bytes": report.torn_bytes,
            "torn_lines": report.torn_lines,
            **({"unproven": report.problem} if report.problem else {}),
        },
    }
