"""python -m runtime.interop.bag propose|import: bags of ROS 1, ROS 2 and MCAP as episodes of a LeRobot dataset."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import robots
from robots.broken_pipe import exit_on_broken_pipe
from runtime.core.errors import RuntimeFault
from runtime.interop.bag_import import ImportedBag, import_bags
from runtime.interop.bag_mapping import propose_mapping, read_mapping, to_toml
from runtime.interop.bag_reader import Bag


@exit_on_broken_pipe
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0 on success, 1 if it was refused or a bag could not be imported."""
    options = _parser().parse_args(arguments)
    try:
        return int(options.run(options))
    except (RuntimeFault, robots.RobotError) as error:
        print(error, file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m runtime.interop.bag", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    proposing = commands.add_parser(
        "propose", help="print a mapping of the topics of a bag, as a file for `import`"
    )
    proposing.add_argument("bag", type=Path, help="MCAP file, folder of a ROS 2 bag, or .bag file of ROS 1")
    proposing.add_argument(
        "--robot", required=True, help="name of a robot with a description, or path of its folder"
    )
    proposing.set_defaults(run=_propose)
    importing = commands.add_parser("import", help="add bags to a dataset, an episode each")
    importing.add_argument("bags", type=Path, nargs="+", metavar="BAG")
    importing.add_argument(
        "--mapping", type=Path, required=True, metavar="FILE", help="as `propose` prints it"
    )
    importing.add_argument("--to", type=Path, required=True, metavar="DIR", help="folder of the dataset")
    importing.set_defaults(run=_import)
    return parser


def _propose(options: argparse.Namespace) -> int:
    with Bag(options.bag) as bag:
        mapping, missing = propose_mapping(bag, robots.load_robot(options.robot))
    print(to_toml(mapping), end="")
    for sentence in missing:
        print(sentence, file=sys.stderr)
    return 0


def _import(options: argparse.Namespace) -> int:
    results = import_bags(options.bags, read_mapping(options.mapping), options.to, report=print)
    for result in results:
        _print_result(result)
    return int(any(result.problem for result in results))


def _print_result(result: ImportedBag) -> None:
    if result.problem:
        print(f"not imported: {result.path}: {result.problem}", file=sys.stderr)
        return
    print(f"imported: {result.path} is episode {result.index}, {result.rows} rows")
    for remark in result.remarks:
        print(f"  {remark}")


if __name__ == "__main__":
    sys.exit(main())
