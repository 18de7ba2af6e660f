"""Completes an episode whose recorder was killed: cuts torn tails, makes lengths equal, writes an outcome."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from runtime.errors import RecordingError
from runtime.recording.base import VIDEO_LOST
from runtime.recording.episode import lock
from runtime.recording.files import disk_fault, read_document, sync_folder, write_whole
from runtime.recording.fragments import count_frames, whole_bytes
from runtime.recording.layout import Layout
from runtime.recording.reader import read_events
from runtime.recording.scrub import verify
from runtime.recording.sealing import MANIFEST, OUTCOME, digests_of, read_outcome, sealed
from runtime.recording.summary import summarise
from runtime.recording.tables import SCHEMAS, read_table, write_table

REASON = "the recorder ended without closing the episode"
UNCUT = "rows.uncut.arrow"  # the rows as they were found, where any had to go


@dataclass(frozen=True, slots=True)
class Report:
    """What a repair found and did.

    "complete": had an outcome, nothing done. "damaged": had one too, and `problem` is what is not as it was recorded,
    which nobody can mend. "repaired": has one now. "recording": is being written right
    now, nothing done. "unreadable": no manifest to go by, nothing done. "failed": `problem` stopped it.
    """

    path: Path
    verdict: Literal["complete", "damaged", "repaired", "recording", "unreadable", "failed"]
    problem: str = ""
    frames: int = 0  # rows that have a frame in every video
    rows_cut: int = 0  # whole rows without a frame in every video
    video_frames: Mapping[str, int] = field(default_factory=dict)
    torn_bytes: int = 0  # cut from the tables and videos
    torn_lines: int = 0  # cut from the events
    lost: Mapping[str, str] = field(default_factory=dict)  # cameras whose video had ended before, and why


def repair(path: Path) -> Report:
    """Complete the episode in folder `path` where it has no outcome; running it again changes nothing.

    Rows without a frame in every video are cut, but for cameras whose video had ended before; the table as found stays
    beside as rows.uncut.arrow. Videos are never re-encoded: only a torn fragment at their end is cut. RecordingError
    where the disk fails.
    """
    if not path.is_dir():
        raise RecordingError(f"{path} is no folder of an episode")
    descriptor = lock(path)
    if descriptor is None:
        return Report(path, "recording", "it is being written right now")
    try:
        return _judge(path)
    except OSError as error:
        raise disk_fault("repairing", path, error) from error
    finally:
        os.close(descriptor)


def repair_all(root: Path) -> list[Report]:
    """Repair every episode in `root` that has no outcome; one that fails does not keep the others."""
    folders = [folder for folder in sorted(root.iterdir()) if folder.is_dir()] if root.is_dir() else []
    return [_attempt(folder) for folder in folders if not (folder / OUTCOME).exists()]


def _attempt(folder: Path) -> Report:
    try:
        return repair(folder)
    except RecordingError as error:
        return Report(folder, "failed", str(error))


def _judge(path: Path) -> Report:
    try:
        layout = Layout.of(read_document(path / MANIFEST))
        if (path / OUTCOME).exists():
            return _closed(path)
    except RecordingError as error:
        return Report(path, "unreadable", str(error))
    return _complete(path, layout)


def _closed(path: Path) -> Report:
    found = verify(path)
    if found.state == "damaged":
        return Report(path, "damaged", found.text)
    frames = read_outcome(path).get("frames")
    return Report(path, "complete", frames=frames if isinstance(frames, int) else 0)


def _complete(path: Path, layout: Layout) -> Report:
    ended = max(file.stat().st_mtime for file in path.iterdir())
    videos, torn_video = _mend_videos(path, layout)
    torn_lines, lost = _mend_events(path)
    going = [frames for camera, frames in videos.items() if camera not in lost]
    frames, cut, torn_tables = _mend_tables(path, layout, going)
    report = Report(path, "repaired", "", frames, cut, videos, torn_video + torn_tables, torn_lines, lost)
    write_whole(path / OUTCOME, sealed(_outcome(report, layout, ended), digests_of(path, layout)))
    return report


def _mend_videos(path: Path, layout: Layout) -> tuple[dict[str, int], int]:
    """Frames per camera, and the torn bytes cut from the ends."""
    frames, torn = {}, 0
    for camera in layout.cameras:
        video = path / f"{camera}.mp4"
        torn += _cut_fragment(video)
        frames[camera] = count_frames(video) if video.exists() else 0
    return frames, torn


def _cut_fragment(video: Path) -> int:
    if not video.exists() or (end := whole_bytes(video)) == 0:
        return 0
    torn = video.stat().st_size - end
    if torn:
        with open(video, "r+b") as file:
            file.truncate(end)
            os.fsync(file.fileno())
    return torn


def _mend_tables(path: Path, layout: Layout, videos: Sequence[int]) -> tuple[int, int, int]:
    """Common number of rows and frames in videos of so many, whole rows cut, torn bytes cut."""
    torn = frames = cut = 0
    for name, schema in SCHEMAS.items():
        file = path / f"{name}.arrow"
        read = read_table(file, schema(layout))
        table = read.table
        torn += read.torn_bytes
        if name == "rows":
            frames = min([table.num_rows, *videos])
            cut = table.num_rows - frames
            table = table.slice(0, frames)
        if name == "rows" and cut:
            _keep_uncut(path)
        if cut or not read.closed:
            write_table(file, table)
    return frames, cut, torn


def _keep_uncut(path: Path) -> None:
    if not (path / UNCUT).exists():
        os.link(path / "rows.arrow", path / UNCUT)
        sync_folder(path)


def _mend_events(path: Path) -> tuple[int, dict[str, str]]:
    """Torn lines, and the cameras whose video had ended, with what was said of it."""
    log = path / "events.jsonl"
    events = read_events(log)
    if events.torn or not log.exists():
        write_whole(log, b"".join(line + b"\n" for line in events.lines))
    said = [json.loads(line) for line in events.lines]
    return events.torn, {
        str(event["data"]["camera"]): str(event["text"]) for event in said if event.get("kind") == VIDEO_LOST
    }


def _outcome(report: Report, layout: Layout, ended: float) -> dict[str, object]:
    summary = summarise(report.path / "rows.arrow", layout, report.frames)
    return {
        "status": "interrupted",
        "reason": f"{REASON}; {report.frames} rows kept, {report.rows_cut} without a frame cut",
        "ended_wall": ended,
        **summary.fields(),
        "rows": report.frames,
        "video_frames": dict(report.video_frames),
        "lost_cameras": {
            camera: {"row": report.video_frames[camera], "reason": why} for camera, why in report.lost.items()
        },
        "repair": {
            "rows_cut": report.rows_cut,
            "torn_bytes": report.torn_bytes,
            "torn_lines": report.torn_lines,
        },
    }
