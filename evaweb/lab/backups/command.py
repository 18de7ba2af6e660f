"""Base of the commands that work on an existing backup."""

from __future__ import annotations

from abc import abstractmethod
from argparse import ArgumentParser
from pathlib import Path
from typing import Any

from django.core.management.base import BaseCommand, CommandError

from evaweb.lab.backups.errors import BackupError


class BackupCommand(BaseCommand):
    """Command that takes the folder of a backup; it does not need a working lab."""

    requires_system_checks = ()

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument(
            "backup", type=Path, metavar="BACKUP", help="one of the folders that `backup` made"
        )

    def handle(self, *args: Any, **options: Any) -> None:
        try:
            self.work_on(options["backup"])
        except BackupError as error:
            raise CommandError(str(error)) from None

    @abstractmethod
    def work_on(self, path: Path) -> None:
        """Do the work of the command.

        Raises:
            BackupError: If it fails.
        """
