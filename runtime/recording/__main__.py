"""`python -m runtime.recording repair|show PATH`: mend episodes after a crash, or say what one holds."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from runtime.errors import RecordingError
from runtime.recording.reader import Episode, open_episode
from runtime.recording.repair import Report, repair, repair_all


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code 0 where all is well, 1 where an episode is unreadable or the disk fails."""
    parser = argparse.ArgumentParser(prog="python -m runtime.recording", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    mend = commands.add_parser("repair", help="complete the episode in PATH, or all unfinished ones below it")
    show = commands.add_parser("show", help="say what the episode in PATH holds")
    for command in (mend, show):
        command.add_argument("path", type=Path)
    options = parser.parse_args(arguments)
    try:
        return _repair(options.path) if options.command == "repair" else _show(options.path)
    except RecordingError as error:
        print(error, file=sys.stderr)
        return 1


def _repair(path: Path) -> int:
    if not path.is_dir():
        raise RecordingError(f"{path} is no folder")
    reports = [repair(path)] if (path / "manifest.json").exists() else repair_all(path)
    print(*(_line(report) for report in reports), sep="\n")
    return int(any(report.verdict in ("unreadable", "failed") for report in reports))


def _line(report: Report) -> str:
    figures = f"{report.frames} rows, {report.rows_cut} cut, {report.torn_bytes} torn bytes"
    return f"{report.path}: {report.verdict}: {report.problem or figures}"


def _show(path: Path) -> int:
    episode = open_episode(path)
    print(*_lines(episode), sep="\n")
    return 0


def _lines(episode: Episode) -> list[str]:
    outcome = episode.outcome
    ended = "unfinished" if outcome is None else f"{outcome.get('status')} ({outcome.get('reason')})"
    return [
        f"episode   {episode.layout.uuid}",
        f"task      {episode.manifest.get('task', '')}",
        f"outcome   {ended}",
        f"rows      {episode.frames} at {episode.layout.fps:g} Hz",
        f"ticks     {episode.ticks.num_rows}, {episode.smoothed.num_rows} asked for something",
        f"raw       {episode.raw.num_rows} rows of chunks",
        f"events    {len(episode.events)}",
        *(f"video     {camera}: {video.stat().st_size} bytes" for camera, video in episode.videos.items()),
    ]


if __name__ == "__main__":
    sys.exit(main())
