"""`manage.py check_machine`: what a lab needs of this machine, what was found, and what to do."""

from __future__ import annotations

import json
from argparse import ArgumentParser
from dataclasses import asdict
from typing import Any

from django.core.management.base import BaseCommand, CommandError

from evaweb.lab import machine_check
from evaweb.lab.machine_check import State


class Command(BaseCommand):
    """Command that prints each check; the exit code is 1 if something will not work."""

    help = "Real-time rights, cores, memory, disk, clock, GPU, sockets and ports of this machine."

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument("--json", action="store_true", help="print the lines as JSON")

    def handle(self, *args: Any, **options: Any) -> None:
        lines = machine_check.lines()
        if options["json"]:
            self.stdout.write(json.dumps([asdict(line) for line in lines], indent=1))
        else:
            for line in lines:
                self.stdout.write(f"{line.state.upper():<10}{line.name}: {line.found}")
                self.stdout.write(f"          {line.means}")
                if line.advice:
                    self.stdout.write(f"          To do: {line.advice}")
        bad = [line.name for line in lines if line.state is State.BAD]
        if bad:
            raise CommandError(f"this will not work: {', '.join(bad)}")
