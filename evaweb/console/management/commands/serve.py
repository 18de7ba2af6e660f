"""manage.py serve: the web process."""

from __future__ import annotations

import argparse
from typing import Any

from django.core.management.base import BaseCommand, CommandError, CommandParser


class Command(BaseCommand):
    """Pages, REST, live stations, and the chronicle of what happens there."""

    help = "Serves pages, REST and live stations until it is told to end."

    def add_arguments(self, parser: CommandParser) -> None:
        parser.formatter_class = argparse.ArgumentDefaultsHelpFormatter
        parser.add_argument("--host", default="127.0.0.1", help="address to listen on")
        parser.add_argument("--port", type=int, default=8000, help="0 takes a free one")
        parser.add_argument(
            "--nice", type=int, default=0, help="give way to others by so much, as soon as it serves"
        )
        parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")

    def handle(self, *args: Any, host: str, port: int, nice: int, lifeline: bool, **options: Any) -> None:
        from evaweb.asgi import application  # not before models are there
        from evaweb.console import server
        from evaweb.console.event_ingest import Chronicle
        from evaweb.listening import PortTaken, listen

        try:
            listener = listen(host, port)
        except PortTaken as error:
            raise CommandError(str(error)) from None
        server.serve(application, listener, beside=Chronicle(), lifeline=lifeline, nice=nice)
