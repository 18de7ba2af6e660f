"""python -m runtime.interop.mcap EPISODE --to FILE: an episode as one MCAP file, for Foxglove, Rerun and ROS 2."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from robots.broken_pipe import exit_on_broken_pipe
from runtime.core.errors import RuntimeFault
from runtime.interop.mcap_export import PICTURES, McapSummary, export_mcap


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Write the file that `arguments` name; return 0 on success, 1 if the command was refused."""
    options = _parser().parse_args(arguments)
    try:
        summary = export_mcap(options.episode, options.to, options.pictures)
    except RuntimeFault as error:
        print(error, file=sys.stderr)
        return 1
    print(*_lines(summary), sep="\n")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m runtime.interop.mcap", description=__doc__)
    parser.add_argument("episode", type=Path, help="folder of a closed episode")
    parser.add_argument(
        "--to", type=Path, required=True, metavar="FILE", help="file to be written; a new one"
    )
    parser.add_argument(
        "--pictures",
        choices=PICTURES,
        default=PICTURES[0],
        help="video: CompressedVideo as recorded, for Foxglove (default); image-h264: CompressedImage as recorded, "
        "for Rerun; jpeg: for all programs, coded again",
    )
    return parser


def _lines(summary: McapSummary) -> Iterator[str]:
    yield f"written: {summary.path}, {summary.messages} messages, {summary.bytes} bytes"
    for topic, count in summary.topics.items():
        yield f"  {topic}: {count}"
    for camera, reason in summary.coded_again.items():
        yield f"coded again: {camera}: {reason}"
    for topic, count in summary.moved.items():
        yield f"moved: {count} stamps of {topic} were earlier than the one before"
    for sentence in summary.left_out:
        yield f"left out: {sentence}"


if __name__ == "__main__":
    sys.exit(main())
