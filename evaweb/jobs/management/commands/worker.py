"""manage.py worker: executes the jobs of some queues until it is stopped."""

from __future__ import annotations

import argparse
from typing import Any

from django.core.checks import Tags
from django.core.management.base import BaseCommand, CommandError, CommandParser

from evaweb.core.errors import EvaError
from evaweb.jobs import worker
from evaweb.jobs.kinds import Queue
from evaweb.jobs.workers import queue_names


class Command(BaseCommand):
    """Command that runs a worker: one job at a time, at the lowest priority."""

    requires_system_checks = (Tags.security, Tags.compatibility)  # the URL checks would import every page
    help = "Does the jobs that wait: previews and datasets of finished episodes."

    def add_arguments(self, parser: CommandParser) -> None:
        parser.formatter_class = argparse.ArgumentDefaultsHelpFormatter
        parser.add_argument(
            "--queues", default=",".join(Queue), help="what this machine has, with commas between"
        )
        parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")

    def handle(self, *args: Any, queues: str, lifeline: bool, **options: Any) -> None:
        try:
            names = queue_names(queues)
        except EvaError as error:
            raise CommandError(str(error)) from None
        worker.run_worker(names, lifeline=lifeline)
