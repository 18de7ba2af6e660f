"""manage.py serve: the web process."""

from __future__ import annotations

import argparse
import logging
from typing import Any

from django.core.management.base import BaseCommand, CommandError, CommandParser
from django.db import DatabaseError

log = logging.getLogger(__name__)


class Command(BaseCommand):
    """Command that runs the web process: pages, REST, live sockets, and event ingest."""

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
        from evaweb.asgi import application  # imported here, after the models are loaded
        from evaweb.console import server
        from evaweb.console.event_ingest import EventIngest
        from evaweb.core.errors import EvaError
        from evaweb.jobs.workers import lab_folder_named
        from evaweb.serving.listeners import PortInUseError, open_listener

        try:
            listener = open_listener(host, port)
            lab_folder_named()
        except DatabaseError as error:
            log.warning(
                "the database does not answer; workers know the lab's data folder as it was: %s", error
            )
        except (PortInUseError, EvaError) as error:
            raise CommandError(str(error)) from None
        server.serve(application, listener, beside=EventIngest(), lifeline=lifeline, nice=nice)
