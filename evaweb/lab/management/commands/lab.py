"""`manage.py lab [DEPLOYMENT...]`: run web, worker and the stations of this machine.

All these processes end when the command ends.
"""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path
from typing import Any

from django.conf import settings
from django.core.management.base import BaseCommand, CommandError

from evaweb.core.errors import EvaError
from evaweb.lab import first_account
from evaweb.lab.benches import Bench
from evaweb.lab.demo_rows import has_no_accounts
from evaweb.lab.lab import Lab, open_lab
from evaweb.lab.lifetime import StopRequested
from evaweb.lab.progress import on_terminal
from evaweb.lab.simulated import benches_of, simulated_options

_FIRST_ACCOUNT = "Nobody can log in yet. Open {url}/first-account/ and type this code:  {code}"


class Command(BaseCommand):
    """Command that runs a lab until Ctrl-C."""

    help = "Start web, worker and the stations of the given deployments; Ctrl-C ends all of them."

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument(
            "deployments", nargs="*", type=Path, metavar="DEPLOYMENT", help="a TOML file per station"
        )
        parser.add_argument("--host", default="127.0.0.1", help="address that the web listens on")
        parser.add_argument("--port", type=int, default=8000, help="port of the web; 0 takes a free one")
        parser.add_argument(
            "--stop-port", type=int, help="port of the process for stops; the one after that of the web"
        )
        simulated_options(parser)

    def handle(self, *args: Any, **options: Any) -> None:
        pictures = benches_of(options).options
        benches = [Bench(path.absolute(), options=pictures) for path in options["deployments"]]
        progress = on_terminal(Lab.STEPS + len(benches))
        try:
            with open_lab(options["host"], options["port"], options["stop_port"], progress) as lab:
                url = lab.start(benches)
                self.stdout.write(
                    f"EVA Web is at {url}   (data in {settings.DATA_DIR})\nCtrl-C ends everything."
                )
                if has_no_accounts():
                    self.stdout.write(_FIRST_ACCOUNT.format(url=url.rstrip("/"), code=first_account.offer()))
                self.stdout.flush()
                lab.watch(benches_of(options))
        except StopRequested:
            self.stdout.write("ended")
        except EvaError as error:
            raise CommandError(str(error)) from None
