"""`python manage.py evaluate PLAN`: carries out a frozen plan at a simulated station of a running lab, without people.

It takes the station's lease and works as an operator does, over REST and the live socket; the plan stays blind for it.
Scores are the bench's ground truth. If it is ended and started again, it continues with the next trial.
"""

from __future__ import annotations

import getpass
import os
from argparse import ArgumentParser
from typing import Any

from django.core.management.base import BaseCommand, CommandError

from evaweb.core.errors import EvaError
from evaweb.lab import plan_runner
from evaweb.lab.progress import on_terminal
from evaweb.lab.rest_client import RestClient

_PASSWORD = "EVA_PASSWORD"  # variable with the password, for use without a terminal


class Command(BaseCommand):
    """The command `evaluate`."""

    help = (
        "Carry out a frozen plan at a simulated station of a running lab, scored by the bench's ground truth."
    )
    requires_system_checks: tuple[str, ...] = ()

    def add_arguments(self, parser: ArgumentParser) -> None:
        """Declare the plan, the station, the lab's address and the account."""
        parser.add_argument("plan", help="name of a frozen plan")
        parser.add_argument("--station", required=True, help="a simulated station")
        parser.add_argument("--url", default="http://127.0.0.1:8000", help="address of the lab")
        parser.add_argument(
            "--as",
            dest="user",
            default="operator",
            help=f"an operator; the password is asked, or in {_PASSWORD}",
        )
        parser.add_argument(
            "--trials", type=int, help="stop after so many; otherwise when the plan is complete"
        )
        parser.add_argument(
            "--lockstep", action="store_true", help="the station runs in lockstep: a run ends by itself"
        )

    def handle(self, *args: Any, **options: Any) -> None:
        most = options["trials"]
        if most is not None and most < 1:
            raise CommandError(f"--trials {most}: allowed: 1 or more")
        try:
            operator = RestClient(options["url"])
            operator.login(options["user"], os.environ.get(_PASSWORD) or getpass.getpass())
            plan_runner.require_simulated(operator, options["station"])
            left = plan_runner.trials_left(operator, options["plan"])
            plan_runner.run_plan(
                operator,
                options["station"],
                options["plan"],
                left if most is None else min(most, left),
                self.stdout.write,
                on_terminal(0),
                lockstep=options["lockstep"],
            )
            left = plan_runner.trials_left(operator, options["plan"])
        except EvaError as error:
            raise CommandError(str(error)) from None
        except KeyboardInterrupt:
            raise CommandError("ended; started again, it continues with the next trial") from None
        self.stdout.write(
            f"{left} trials are left" if left else "all trials are made: its owner may close the plan"
        )
