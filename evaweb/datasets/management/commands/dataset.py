"""manage.py dataset: operations on the lab's datasets, executed at once in this process."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any
from uuid import UUID

from django.core.management.base import BaseCommand, CommandError

from evaweb.core.errors import EvaError
from evaweb.datasets import dataset_jobs
from evaweb.datasets.dataset_orders import full_name
from evaweb.datasets.importing import import_dataset
from evaweb.datasets.overview import folder_named, overviews
from evaweb.episodes.dataset_membership import sync_memberships
from evaweb.episodes.folders import data_dir
from evaweb.episodes.job_kinds import publish_episode
from evaweb.episodes.models import Episode
from evaweb.jobs.kinds import JobContext
from runtime.datasets.__main__ import add_commands, renamed
from runtime.recording.files import RecordingError

_ONLY_LOOK = ("list", "check", "push")


class Command(BaseCommand):
    """Command with the operations on datasets.

    Names are those of the pages: cups is DATA/datasets/cups. A path that starts with / or . is used as given.
    """

    help = "Publishes, imports, converts, merges, splits, prunes, repairs, checks, lists and pushes datasets."

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        commands = parser.add_subparsers(dest="what", required=True, metavar="COMMAND")
        listing = commands.add_parser("list", help="all datasets below the data folder")
        listing.set_defaults(run=self._list)
        publishing = commands.add_parser("publish", help="publish finished episodes where the lab puts them")
        publishing.add_argument("episodes", nargs="+", type=UUID, metavar="UUID", help="of the recording")
        publishing.set_defaults(run=self._publish)
        importing = commands.add_parser(
            "import", help="make a dataset's episodes ones of this lab, to be reviewed"
        )
        importing.add_argument("dataset", type=_folder, help="folder of the dataset, of any version")
        importing.add_argument(
            "--to", default="", metavar="NAME", help="of the copy; that of its folder without"
        )
        importing.add_argument(
            "--state", default="", metavar="COLUMN", help="of measured joints, by its new name"
        )
        importing.add_argument("--robot", default="", help="whose numbers these are, in its order of joints")
        importing.add_argument(
            "--rename", action="append", default=[], metavar="OLD=NEW", help="of a feature"
        )
        importing.add_argument("--reencode", action="store_true", help="code again what cannot be copied")
        importing.set_defaults(run=self._import)
        add_commands(commands, dataset=_folder, publishing=False)

    def handle(self, *args: Any, **options: Any) -> None:
        try:
            code = int(options["run"](argparse.Namespace(**options)))
            problems = () if options["what"] in _ONLY_LOOK else sync_memberships()
        except (RecordingError, EvaError) as error:
            raise CommandError(str(error)) from error
        for problem in problems:
            self.stderr.write(self.style.WARNING(problem))
        if code:
            raise CommandError("not all is well: see above", returncode=code)

    def _list(self, options: argparse.Namespace) -> int:
        rows = overviews()
        for row in rows:
            if row.problem:
                self.stdout.write(f"{row.name}: {row.problem}")
                continue
            checked = dataset_jobs.latest_check(row.name)
            state = "not checked" if checked is None else _state(checked)
            self.stdout.write(
                f"{row.name}: {row.version}, {row.robot or 'robot not said'}, {row.episodes} episodes, "
                f"{row.frames} rows, {row.size / 1e6:.1f} MB, {state}"
            )
        if not rows:
            self.stdout.write(f"there is no dataset below {data_dir()}")
        return int(any(row.problem for row in rows))

    def _import(self, options: argparse.Namespace) -> int:
        result = import_dataset(
            options.dataset,
            to=options.to,
            state=options.state,
            robot=options.robot,
            rename=renamed(options.rename),
            reencode=options.reencode,
            tell=self.stdout.write,
        )
        for index, uuid in enumerate(result.episodes):
            self.stdout.write(f"{uuid} is episode {index} of {result.dataset}")
        self.stdout.write(f"imported: {len(result.episodes)} episodes, {result.made} of them new")
        return 0

    def _publish(self, options: argparse.Namespace) -> int:
        code = 0
        for uuid in options.episodes:
            if not Episode.objects.filter(uuid=uuid).exists():
                raise EvaError(f"episode {uuid} is not in the database: run manage.py reconcile")
            result = publish_episode(JobContext({"uuid": str(uuid)}, self.stdout.write))
            if result["published"]:
                self.stdout.write(
                    f"{uuid} is episode {result['index']} of {result['dataset']}, {result['frames']} rows"
                )
            else:
                self.stderr.write(f"{uuid} is not published: {result['why']}")
                code = 1
        return code


def _state(checked: dataset_jobs.LatestCheck) -> str:
    if not checked.fresh:
        return "changed since its check"
    return f"{len(checked.problems)} problems" if checked.problems else "whole"


def _folder(name: str) -> Path:
    """Return the folder of a dataset name or path."""
    if name.startswith(("/", ".")):
        return Path(name)
    try:
        return folder_named(full_name(name))
    except EvaError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
