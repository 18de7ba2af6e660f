"""python -m runtime.datasets publish EPISODE --to DIR | check DIR | recover DIR."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from runtime.datasets.consistency import check
from runtime.datasets.published import publish
from runtime.datasets.staging import locked, recover
from runtime.errors import RecordingError, RuntimeFault


def main(arguments: Sequence[str] | None = None) -> int:
    """0 where all is well, 1 where a check found something or a publication was refused."""
    options = _parser().parse_args(arguments)
    try:
        return int(options.run(options))
    except RuntimeFault as error:
        print(error, file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m runtime.datasets", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    publishing = commands.add_parser("publish", help="publish a finished episode into a LeRobot v2.1 dataset")
    publishing.add_argument("episode", type=Path, help="folder of the episode")
    publishing.add_argument("--to", type=Path, required=True, metavar="DIR", help="folder of the dataset")
    publishing.add_argument(
        "--include-interrupted", action="store_true", help="also one that was interrupted or failed"
    )
    success = publishing.add_mutually_exclusive_group()
    success.add_argument("--success", action="store_const", const=True, default=None, help="it succeeded")
    success.add_argument("--failure", action="store_const", const=False, dest="success", help="it did not")
    publishing.set_defaults(run=_publish)
    checking = commands.add_parser("check", help="check a dataset against its own metadata")
    checking.add_argument("dataset", type=Path, help="folder of the dataset")
    checking.set_defaults(run=_check)
    recovering = commands.add_parser("recover", help="take back what an interrupted publication left")
    recovering.add_argument("dataset", type=Path, help="folder of the dataset")
    recovering.set_defaults(run=_recover)
    return parser


def _publish(options: argparse.Namespace) -> int:
    done = publish(
        options.episode,
        options.to,
        success=options.success,
        include_interrupted=options.include_interrupted,
    )
    verb = "published" if done.created else "published anew"
    print(
        f"{verb}: {options.episode} as episode {done.episode_index} of {done.dataset}, {done.frames} frames"
    )
    return 0


def _check(options: argparse.Namespace) -> int:
    problems = check(options.dataset)
    for problem in problems:
        print(problem)
    if not problems:
        print(f"{options.dataset} is whole")
    return 1 if problems else 0


def _recover(options: argparse.Namespace) -> int:
    if not options.dataset.is_dir():
        raise RecordingError(f"there is no dataset folder {options.dataset}")
    with locked(options.dataset):
        recover(options.dataset)
    return _check(options)


if __name__ == "__main__":
    sys.exit(main())
