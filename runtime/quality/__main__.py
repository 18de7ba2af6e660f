"""`python -m runtime.quality EPISODE|DATASET`: report faults of our episodes and of LeRobot datasets."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from robots.broken_pipe import exit_on_broken_pipe
from runtime.core.errors import RecordingError
from runtime.datasets import layout
from runtime.datasets.reader import open_dataset
from runtime.quality.inspection import check_dataset_episode, check_episode
from runtime.quality.report import Report
from runtime.quality.settings import QualitySettings, read_settings

SHOWN = 20  # most flags of an episode that are printed


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Print the reports; return 0 if every episode is clean, 1 if one is flagged, 2 if one cannot be checked."""
    options = _parser().parse_args(arguments)
    clean, first = True, True
    try:
        settings = read_settings(options.settings) if options.settings else QualitySettings()
        for report in _reports(options, settings):
            clean = clean and report.clean
            if options.json:
                print(json.dumps(report.to_dict(), ensure_ascii=False, allow_nan=False), flush=True)
            else:
                print(*([] if first else [""]), *_lines(report), sep="\n", flush=True)
            first = False
    except RecordingError as error:
        print(error, file=sys.stderr)
        return 2
    return 0 if clean else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m runtime.quality", description=__doc__)
    parser.add_argument(
        "paths", type=Path, nargs="+", metavar="EPISODE|DATASET", help="the folder of one, or of many"
    )
    parser.add_argument("--json", action="store_true", help="a JSON object per episode, a line each")
    parser.add_argument("--episodes", type=int, nargs="+", metavar="N", help="of a dataset, only these")
    parser.add_argument(
        "--state", default="", metavar="COLUMN", help="measured joints of a dataset of others"
    )
    parser.add_argument("--settings", type=Path, metavar="FILE.toml", help="other bounds than the usual ones")
    return parser


def _reports(options: argparse.Namespace, settings: QualitySettings) -> Iterator[Report]:
    for path in options.paths:
        if (path / layout.INFO).exists():
            dataset = open_dataset(path)
            for index in options.episodes or [entry.index for entry in dataset.episodes]:
                yield check_dataset_episode(dataset, index, settings, state=options.state)
        else:
            for folder in _episodes(path):
                yield check_episode(folder, settings)


def _episodes(path: Path) -> list[Path]:
    if (path / "manifest.json").exists():
        return [path]
    folders = sorted(manifest.parent for manifest in path.glob("*/manifest.json"))
    if not folders:
        raise RecordingError(
            f"{path} is no episode and no dataset: neither manifest.json nor {layout.INFO} is in it"
        )
    return folders


def _lines(report: Report) -> list[str]:
    verdict = "clean" if report.clean else "flagged"
    lines = [f"{report.episode}: {verdict}, {report.frames} frames at {report.fps:g} Hz"]
    lines += [f"  {flag.severity:8}{flag.kind:18}{flag.text}" for flag in report.flags[:SHOWN]]
    more = sum(count.flags for count in report.counts.values()) - min(SHOWN, len(report.flags))
    lines += [f"  and {more} more: --json lists them"] if more > 0 else []
    return lines + [f"  {sentence}" for sentence in report.unchecked]


if __name__ == "__main__":
    sys.exit(main())
