"""`python -m runtime.recording repair|show|export|scrub PATH`: repair after a crash, show, export, verify."""

from __future__ import annotations

import argparse
import json
import os
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from robots.broken_pipe import exit_on_broken_pipe
from runtime.core.errors import RecordingError
from runtime.recording.archive_index import stored_files
from runtime.recording.export import write_export
from runtime.recording.quarantine import update_mark
from runtime.recording.reader import Episode, open_episode
from runtime.recording.repair import RepairReport, repair, repair_all
from runtime.recording.scrub import episodes_in, verify_episode


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit code.

    0 is success; 1 means that an episode is unreadable or damaged, or that the disk fails. For scrub, 1 means damage,
    and 2 that an episode could not be read or marked.
    """
    options = _parser().parse_args(arguments)
    try:
        if options.command == "export":
            if options.background:
                _lower_priority()
            return _export(options.paths, options.to)
        if options.command == "scrub":
            return _scrub(options.paths, options.json)
        return _repair(options.path) if options.command == "repair" else _show(options.path)
    except RecordingError as error:
        print(error, file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m runtime.recording", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    mend = commands.add_parser("repair", help="complete the episode in PATH, or all unfinished ones below it")
    show = commands.add_parser("show", help="say what the episode in PATH holds")
    for command in (mend, show):
        command.add_argument("path", type=Path)
    out = commands.add_parser("export", help="write the three streams of an episode into one parquet table")
    out.add_argument(
        "paths", type=Path, nargs="+", metavar="EPISODE", help="its folder, or one of many of them"
    )
    out.add_argument("--to", type=Path, metavar="DATA", help="data folder; that of the episode if not given")
    out.add_argument(
        "--background", action="store_true", help="at the lowest priority; end when standard input ends"
    )
    scrub = commands.add_parser(
        "scrub", help="verify every file against its digest; exit code 1 tells damage"
    )
    scrub.add_argument(
        "paths", type=Path, nargs="+", metavar="PATH", help="an episode, a folder of many, or the data folder"
    )
    scrub.add_argument("--json", action="store_true", help="one object per episode and line")
    return parser


def _scrub(paths: Sequence[Path], as_json: bool) -> int:
    """Verify every episode of `paths` and return the exit code.

    An episode that cannot be read or marked does not stop the verification of the rest.
    """
    codes = {0}
    for path in paths:
        try:
            codes |= {_scrubbed(folder, as_json) for folder in episodes_in(path)}
        except RecordingError as error:
            codes.add(2)
            print(error, file=sys.stderr)
    return min(codes - {0}, default=0)


def _scrubbed(folder: Path, as_json: bool) -> int:
    """Print and mark the result for one episode; return its exit code."""
    damaged = False
    try:
        verdict = verify_episode(folder)
        damaged = verdict.state == "damaged"
        print(
            json.dumps(verdict.to_dict()) if as_json else f"{folder}: {verdict.state}: {verdict.text}",
            flush=True,
        )
        update_mark(verdict)
    except RecordingError as error:
        print(error, file=sys.stderr)
        return 1 if damaged else 2
    return int(damaged)


def _repair(path: Path) -> int:
    if not path.is_dir():
        raise RecordingError(f"{path} is no folder")
    reports = [repair(path)] if (path / "manifest.json").exists() else repair_all(path)
    print(*(_line(report) for report in reports), sep="\n")
    return int(any(report.verdict in ("unreadable", "damaged", "failed") for report in reports))


def _line(report: RepairReport) -> str:
    figures = f"{report.frames} rows, {report.rows_cut} cut, {report.torn_bytes} torn bytes"
    details = "; ".join(filter(None, (figures if report.verdict == "repaired" else "", report.problem)))
    return f"{report.path}: {report.verdict}: {details or figures}"


def _show(path: Path) -> int:
    episode = open_episode(path, videos=False)
    print(*_lines(episode), sep="\n")
    return 0


def _lines(episode: Episode) -> list[str]:
    outcome = episode.outcome
    ended = "unfinished" if outcome is None else f"{outcome.get('status')} ({outcome.get('reason')})"
    return [
        f"episode   {episode.layout.uuid}",
        f"task      {episode.manifest.get('task', '')}",
        f"mode      {episode.manifest.get('mode', '')}, strategy {episode.manifest.get('strategy', '')}",
        f"outcome   {ended}",
        f"rows      {episode.frames} at {episode.layout.fps:g} Hz",
        f"ticks     {episode.ticks.num_rows}, {episode.smoothed.num_rows} asked for something",
        f"raw       {episode.raw.num_rows} rows of chunks",
        f"events    {len(episode.events)}",
        *(
            f"video     {camera}: {_size(episode.path / f'{camera}.mp4')}"
            for camera in episode.layout.cameras
        ),
    ]


def _size(video: Path) -> str:
    """Return the size of a video as words. Raises RecordingError if it is neither here nor in the lab's store."""
    if video.is_file():
        return f"{video.stat().st_size} bytes"
    if video.name in stored_files(video.parent):
        return "in the lab's store"
    raise RecordingError(f"{video} is absent, but the manifest lists camera {video.stem}")


def _export(paths: Sequence[Path], to: Path | None) -> int:
    """Export every episode of `paths` and return the exit code; an episode that fails does not stop the rest."""
    failed = 0
    for folder in (episode for path in paths for episode in episodes_in(path)):
        try:
            print(write_export(folder, to or _data_of(folder)), flush=True)
        except RecordingError as error:
            failed += 1
            print(error, file=sys.stderr)
    return int(failed > 0)


def _data_of(folder: Path) -> Path:
    """Return the data folder of DATA/episodes/<uuid>. Raises RecordingError for an episode elsewhere."""
    episodes = folder.absolute().parent
    if episodes.name != "episodes":
        raise RecordingError(f"{folder} does not lie in DATA/episodes: say where to export to with --to DATA")
    return episodes.parent


def _lower_priority() -> None:
    """Give this process the lowest priority, and end it together with the process that started it."""
    os.nice(19)
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    threading.Thread(target=_end_with_standard_input, daemon=True).start()


def _end_with_standard_input() -> None:
    """End the process when standard input closes, because the process that started it holds the other end.

    An export that is being written is lost, but no damage results: it is only a draft until it is complete.
    """
    while os.read(0, 4096):
        pass
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
