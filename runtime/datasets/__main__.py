"""python -m runtime.datasets publish|convert|merge|split|delete|repair|check|push|pull|croissant: LeRobot datasets."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from typing import Any

from robots.broken_pipe import exit_on_broken_pipe
from runtime.core.errors import RecordingError, RuntimeFault
from runtime.datasets import layout, operations
from runtime.datasets.assemble import AssemblyResult
from runtime.datasets.card import LICENCES
from runtime.datasets.consistency import check_with_remarks
from runtime.datasets.croissant import LICENCES as DESCRIBED
from runtime.datasets.croissant import describe_croissant
from runtime.datasets.hub import pull, push
from runtime.datasets.publishing import publish
from runtime.datasets.reader import open_dataset


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that `arguments` name; return 0 on success, 1 if a check found a problem or the command was
    refused.
    """
    options = _parser().parse_args(arguments)
    try:
        return int(options.run(options))
    except RuntimeFault as error:
        print(error, file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m runtime.datasets", description=__doc__)
    add_commands(parser.add_subparsers(required=True, metavar="COMMAND"))
    return parser


MOST = 100_000  # greatest number of episodes in one command
Folder = Callable[[str], Path]  # converts the name of a dataset or an episode to its folder


def add_commands(
    commands: Any, dataset: Folder = Path, episode: Folder = Path, publishing: bool = True
) -> None:
    """Add all commands to `commands`, the subparsers of a parser.

    Each sets `run` to its function, which returns the exit code. `dataset` and `episode` convert names given by a
    person to folders.
    """
    if publishing:
        _add_publish(
            commands.add_parser("publish", help="publish a finished episode into a dataset"), dataset, episode
        )
    converting = commands.add_parser("convert", help="write a dataset as a new one of v2.1 or v3.0")
    converting.add_argument("dataset", type=dataset, help="folder of the dataset, of any version")
    _add_target(converting, dataset, required=True)
    converting.add_argument(
        "--rename",
        action="append",
        default=[],
        metavar="OLD=NEW",
        help="give a feature another name; repeatable",
    )
    converting.set_defaults(run=_convert)
    merging = commands.add_parser("merge", help="write the episodes of several datasets as a new one")
    merging.add_argument("datasets", type=dataset, nargs="+", help="folders of the datasets, in order")
    _add_target(merging, dataset, required=False)
    merging.set_defaults(run=_merge)
    splitting = commands.add_parser("split", help="write some episodes of a dataset as new ones")
    splitting.add_argument("dataset", type=dataset, help="folder of the dataset")
    splitting.add_argument(
        "parts",
        nargs="+",
        metavar="NAME=EPISODES",
        help="a folder below --to and its episodes: train=0:40,45",
    )
    _add_target(splitting, dataset, required=False)
    splitting.set_defaults(run=_split)
    deleting = commands.add_parser("delete", help="take episodes out of a dataset; later ones move up")
    deleting.add_argument("dataset", type=dataset, help="folder of the dataset")
    deleting.add_argument("episodes", help="which: 3 or 0:4,7")
    deleting.add_argument("--reencode", action="store_true", help=_REENCODE)
    deleting.set_defaults(run=_delete)
    repairing = commands.add_parser(
        "repair", aliases=["recover"], help="take back what a crash left, and check"
    )
    repairing.add_argument("dataset", type=dataset, help="folder of the dataset")
    repairing.set_defaults(run=_repair)
    checking = commands.add_parser("check", help="check a dataset against its own metadata")
    checking.add_argument("dataset", type=dataset, help="folder of the dataset")
    checking.set_defaults(run=_check)
    pushing = commands.add_parser("push", help="upload a dataset to the Hugging Face hub")
    pushing.add_argument("dataset", type=dataset, help="folder of the dataset")
    pushing.add_argument("repository", help="OWNER/NAME on the hub; created where it is not there")
    pushing.add_argument("--public", action="store_true", help="one that is created can be seen by everybody")
    pushing.add_argument(
        "--licence",
        choices=LICENCES,
        default="",
        help="that the dataset's card states; none is granted without",
    )
    pushing.set_defaults(run=_push)
    pulling = commands.add_parser("pull", help="download a dataset from the Hugging Face hub")
    pulling.add_argument("repository", help="OWNER/NAME on the hub")
    pulling.add_argument("--to", type=dataset, required=True, metavar="DIR", help="new folder of the dataset")
    pulling.add_argument("--revision", default="", help="branch, tag or commit; the newest files without")
    pulling.set_defaults(run=_pull)
    describing = commands.add_parser(
        "croissant", help="describe a dataset for catalogues, as Croissant JSON-LD"
    )
    describing.add_argument("dataset", type=dataset, help="folder of the dataset")
    describing.add_argument("--licence", choices=DESCRIBED, required=True, help="that the description states")
    describing.add_argument(
        "--url", required=True, help="address of the page at which the dataset is published"
    )
    describing.add_argument("--name", help="the name of its folder without")
    describing.add_argument("--description", help="in a sentence; what its files say without")
    describing.set_defaults(run=_describe)


_REENCODE = "where pictures cannot be copied as they are coded, code them again"


def _add_publish(publishing: argparse.ArgumentParser, dataset: Folder, episode: Folder) -> None:
    publishing.add_argument("episode", type=episode, help="folder of the episode")
    publishing.add_argument("--to", type=dataset, required=True, metavar="DIR", help="folder of the dataset")
    publishing.add_argument(
        "--version",
        choices=layout.WRITABLE_VERSIONS,
        help=f"of a new dataset, {layout.DEFAULT_VERSION} without; one that is there keeps its own",
    )
    publishing.add_argument(
        "--include-interrupted", action="store_true", help="also one that was interrupted or failed"
    )
    success = publishing.add_mutually_exclusive_group()
    success.add_argument("--success", action="store_const", const=True, default=None, help="it succeeded")
    success.add_argument("--failure", action="store_const", const=False, dest="success", help="it did not")
    publishing.set_defaults(run=_publish)


def _add_target(parser: argparse.ArgumentParser, dataset: Folder, required: bool) -> None:
    parser.add_argument("--to", type=dataset, required=True, metavar="DIR", help="folder of what is written")
    parser.add_argument(
        "--version",
        choices=layout.WRITABLE_VERSIONS,
        required=required,
        help="of what is written" + ("" if required else "; that of the first dataset without"),
    )
    parser.add_argument("--reencode", action="store_true", help=_REENCODE)


def _publish(options: argparse.Namespace) -> int:
    result = publish(
        options.episode,
        options.to,
        success=options.success,
        include_interrupted=options.include_interrupted,
        version=options.version,
    )
    verb = "published" if result.created else "published anew"
    print(
        f"{verb}: {options.episode} as episode {result.episode_index} of {result.dataset}, {result.frames} frames"
    )
    if result.remark:
        print(f"remark: {result.remark}")
    return 0


def _convert(options: argparse.Namespace) -> int:
    return _print_result(
        operations.convert(
            options.dataset,
            options.to,
            options.version,
            rename=renamed(options.rename),
            reencode=options.reencode,
        )
    )


def renamed(pairs: Sequence[str]) -> dict[str, str]:
    """Parse pairs OLD=NEW; return the new name by old name. Raises: RecordingError."""
    parsed = [pair.partition("=") for pair in pairs]
    for old, sign, new in parsed:
        if not (old and sign and new):
            raise RecordingError(f"--rename {old}{sign}{new}: expected OLD=NEW")
    return {old: new for old, _, new in parsed}


def _merge(options: argparse.Namespace) -> int:
    return _print_result(
        operations.merge(options.datasets, options.to, options.version, reencode=options.reencode)
    )


def _split(options: argparse.Namespace) -> int:
    targets = {}
    for part in options.parts:
        name, _, which = part.partition("=")
        if Path(name).name != name or name in ("", ".", "..") or options.to / name in targets:
            raise RecordingError(f"{part!r}: expected NAME=EPISODES, with a name of its own for a folder")
        targets[options.to / name] = episodes(which)
    results = operations.split(options.dataset, targets, options.version, reencode=options.reencode)
    return max(_print_result(result) for result in results)


def _delete(options: argparse.Namespace) -> int:
    return _print_result(
        operations.delete(options.dataset, episodes(options.episodes), reencode=options.reencode)
    )


def _repair(options: argparse.Namespace) -> int:
    return _report(options.dataset, operations.repair(options.dataset))


def _check(options: argparse.Namespace) -> int:
    report = check_with_remarks(options.dataset)
    for remark in report.remarks:
        print(f"remark: {remark}")
    return _report(options.dataset, report.problems)


def _push(options: argparse.Namespace) -> int:
    private, licence = not options.public, options.licence
    address = push(options.dataset, options.repository, private=private, licence=licence, tell=print)
    print(f"pushed: {options.dataset} to {address}")
    return 0


def _pull(options: argparse.Namespace) -> int:
    pulled = pull(options.repository, options.to, revision=options.revision, tell=print)
    print(f"pulled: {len(pulled.episodes)} episodes of {options.repository} to {options.to}")
    return 0


def _describe(options: argparse.Namespace) -> int:
    opened = open_dataset(options.dataset)
    name = options.name or opened.root.resolve().name
    words = (
        options.description or f"{len(opened.episodes)} episodes in the format of LeRobot {opened.version}."
    )
    described = describe_croissant(
        opened, name, licence=options.licence, url=options.url, description=words, published=date.today()
    )
    print(json.dumps(described, indent=1))
    return 0


def episodes(text: str, most: int = MOST) -> list[int]:
    """Parse indices of episodes from "3", "0:4" (without 4) or several of them separated by commas.

    Raises:
        RecordingError: The text is invalid or names more than `most` episodes.
    """
    indices: list[int] = []
    for part in text.split(","):
        first, colon, end = part.partition(":")
        if not is_index(first) or (colon and not (is_index(end) and int(first) < int(end))):
            raise RecordingError(f"{text!r:.80} names no episodes: expected 3, or 0:4 (without 4), or 0:4,7")
        some = range(int(first), int(end)) if colon else [int(first)]
        if len(indices) + len(some) > most:  # probably a typing error, which would exhaust the memory
            raise RecordingError(f"{text!r:.80} names too many episodes: at most {most:,} in one order")
        indices += some
    return indices


def is_index(text: str) -> bool:
    """Return True if the text can be an index of an episode: at most 9 decimal digits."""
    return text.isascii() and text.isdecimal() and len(text) < 10


def _print_result(result: AssemblyResult) -> int:
    print(f"written: {result.dataset}, {result.version}, {result.episodes} episodes, {result.frames} frames")
    for video in result.encoded:
        print(f"coded again: {video}")
    for thing in result.left_out:
        print(f"left out: {thing}")
    return 0


def _report(dataset: Path, problems: list[str]) -> int:
    for problem in problems:
        print(problem)
    if not problems:
        print(f"{dataset} is whole")
        print("\n".join(_describe_features(layout.read_info(dataset))))
    return 1 if problems else 0


def _describe_features(info: layout.Info) -> list[str]:
    """Return two lines with the features that a policy reads and writes, which LeRobot finds by their names'
    prefixes.
    """
    names = {
        "inputs": [key for key in info["features"] if key.startswith("observation")],
        "outputs": [key for key in info["features"] if key.startswith("action")],
    }
    return [f"{kind} of a policy: {', '.join(keys) or 'none'}" for kind, keys in names.items()]


if __name__ == "__main__":
    sys.exit(main())
