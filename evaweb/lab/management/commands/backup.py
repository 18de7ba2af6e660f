"""`manage.py backup FOLDER`: backup of database and data folder, also of a running lab."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError
from pathlib import Path
from typing import Any

from django.core.management.base import BaseCommand, CommandError

from evaweb.lab.backups import backup
from evaweb.lab.backups.errors import BackupError


class Command(BaseCommand):
    """Command that prints what was copied, and which folders changed meanwhile."""

    help = "Copies database and data folder into a new folder in FOLDER, with a digest of every file."

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument(
            "folder", type=Path, metavar="FOLDER", help="of all backups of this lab, outside the data folder"
        )
        parser.add_argument(
            "--keep", type=_count, metavar="N", help="remove the oldest whole backups beyond N"
        )

    def handle(self, *args: Any, **options: Any) -> None:
        try:
            copy = backup.make(options["folder"], keep=options["keep"], tell=self.stderr.write)
        except BackupError as error:
            raise CommandError(str(error)) from None
        files, database = copy.about["files"], copy.about["database"]
        for folder in files["changing"]:
            self.stdout.write(
                f"{folder} changed all the while: its files are of different moments; publish a dataset anew"
            )
        self.stdout.write(
            f"{copy.path}: {sum(database['rows'].values()):,} rows, {files['count']:,} files, "
            f"{files['bytes']:,} bytes, {files['linked']:,} files shared with the backup before"
        )


def _count(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and int(text)):
        raise ArgumentTypeError(f"{text!r}; allowed: whole numbers from 1")
    return int(text)
