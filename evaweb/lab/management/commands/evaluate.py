"""`python manage.py evaluate PLAN`: carries out a frozen plan at a simulated station, without people.

With --copies it starts copies of the station, each for one trial on a virtual clock; workers of a running lab carry out
some of them. Otherwise it takes the lease of the station in a running lab and works as an operator does, over REST and
the live socket. Either way the plan stays blind for it, and scores are the bench's ground truth. If it is ended and
started again, it continues with the next trial.
"""

from __future__ import annotations

import getpass
import os
from argparse import ArgumentParser
from typing import Any

from django.contrib.auth.models import User
from django.core.management.base import BaseCommand, CommandError

from evaweb.core.errors import EvaError
from evaweb.lab import plan_runner
from evaweb.lab.progress import on_terminal
from evaweb.lab.rest_client import RestClient
from evaweb.plans import copies
from evaweb.plans.selectors import plan_get
from evaweb.stations.selectors import station_get

_PASSWORD = "EVA_PASSWORD"  # variable with the password, for use without a terminal
_ENDED = "ended; started again, it continues with the next trial"


class Command(BaseCommand):
    """The command `evaluate`."""

    help = "Carry out a frozen plan at a simulated station, scored by the bench's ground truth."
    requires_system_checks: tuple[str, ...] = ()

    def add_arguments(self, parser: ArgumentParser) -> None:
        """Declare the plan, the station, how trials are carried out, and the account."""
        parser.add_argument("plan", help="name of a frozen plan")
        parser.add_argument("--station", required=True, help="a simulated station")
        parser.add_argument(
            "--copies",
            type=int,
            metavar="N",
            help="N copies of the station at the same time, each for one trial, as fast as the machine can",
        )
        parser.add_argument(
            "--url", default="http://127.0.0.1:8000", help="address of the lab, without --copies"
        )
        parser.add_argument(
            "--as",
            dest="user",
            default="operator",
            help=f"an operator; without --copies the password is asked, or in {_PASSWORD}",
        )
        parser.add_argument(
            "--trials", type=int, help="stop after so many; otherwise when the plan is complete"
        )
        parser.add_argument(
            "--lockstep",
            action="store_true",
            help="without --copies: the station runs in lockstep: a run ends by itself",
        )

    def handle(self, *args: Any, **options: Any) -> None:
        most = options["trials"]
        if most is not None and most < 1:
            raise CommandError(f"--trials {most}: allowed: 1 or more")
        try:
            left = self._at_copies(options) if options["copies"] is not None else self._at_station(options)
        except EvaError as error:
            raise CommandError(str(error)) from None
        except KeyboardInterrupt:
            raise CommandError(_ENDED) from None
        self.stdout.write(
            f"{left} trials are left" if left else "all trials are made: its owner may close the plan"
        )

    def _at_copies(self, options: dict[str, Any]) -> int:
        """Carry out trials at copies of the station; return how many are left."""
        user = User.objects.filter(username=options["user"], is_active=True).first()
        if user is None:
            raise CommandError(f"--as {options['user']}: there is no such account; allowed: an operator's")
        plan = plan_get(name=options["plan"], user=user)
        copies.carry_out(
            user=user,
            plan=plan,
            station=station_get(name=options["station"]),
            count=options["copies"],
            most=options["trials"],
            tell=self.stdout.write,
        )
        return copies.trials_left(plan)

    def _at_station(self, options: dict[str, Any]) -> int:
        """Carry out trials at the station itself, over REST; return how many are left."""
        most = options["trials"]
        operator = RestClient(options["url"])
        try:
            password = os.environ.get(_PASSWORD) or getpass.getpass()
        except EOFError:
            raise CommandError(
                f"no terminal asks for the password of {options['user']}: set {_PASSWORD}"
            ) from None
        operator.login(options["user"], password)
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
        return plan_runner.trials_left(operator, options["plan"])
