"""Command that writes a plan's offline report: pages, data, and the program that recomputes all numbers."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path
from typing import Any

from django.core.management.base import BaseCommand, CommandError

from evaweb.core.errors import EvaError
from evaweb.results.reports.reporting import write_report
from evaweb.results.selectors import plan_get


class Command(BaseCommand):
    """Command that writes the offline report of a plan: `manage.py eval_report PLAN --out DIR`."""

    help = "Write the offline report of a plan, with its data and a program that computes every number again."

    def add_arguments(self, parser: ArgumentParser) -> None:
        """Declare the arguments: the plan and the folder."""
        parser.add_argument("plan", help="its name; with /VERSION where it is not the newest one")
        parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
        parser.add_argument(
            "--sealed",
            action="store_true",
            help="also of a plan that is blind and not yet revealed: whoever reads it runs none of its trials",
        )

    def handle(self, *args: Any, **options: Any) -> None:
        """Write the report and print its first page."""
        name, _, version = options["plan"].partition("/")
        if version and not version.isdecimal():
            raise CommandError(f"version {version!r}; allowed: a number, as in {name}/2")
        try:
            plan = plan_get(name=name, version=int(version) if version else None)
            if plan.sealed and not options["sealed"]:
                raise CommandError(
                    f"{plan} is blind until it is revealed: --sealed writes its report all the same"
                )
            page = write_report(plan, options["out"])
        except EvaError as error:
            raise CommandError(str(error)) from None
        self.stdout.write(f"wrote {page}; check it with: cd {options['out']} && python3 -m recompute")
