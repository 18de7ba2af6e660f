"""manage.py worker: does the jobs of some queues until it is told to end."""

from __future__ import annotations

import argparse
from typing import Any

from django.core.checks import Tags
from django.core.management.base import BaseCommand, CommandError, CommandParser

from evaweb.jobs import worker


class Command(BaseCommand):
    """One process, one job at a time, at the lowest priority."""

    requires_system_checks = (Tags.security, Tags.compatibility)  # those of addresses load every page
    help = "Does the jobs that wait: previews and datasets of finished episodes."

    def add_arguments(self, parser: CommandParser) -> None:
        parser.formatter_class = argparse.ArgumentDefaultsHelpFormatter
        parser.add_argument("--queues", default="lab", help="names with commas between them")
        parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")

    def handle(self, *args: Any, queues: str, lifeline: bool, **options: Any) -> None:
        names = [name.strip() for name in queues.split(",") if name.strip()]
        wrong = [name for name in names if not name.replace("-", "").replace("_", "").isalnum()]
        if not names or wrong:
            raise CommandError(
                f"--queues {queues!r}: allowed are names of letters, digits, '-' and '_', with commas between"
            )
        worker.run(names, lifeline=lifeline)
