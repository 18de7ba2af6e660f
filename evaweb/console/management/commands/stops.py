"""manage.py stops: the process for stops."""

from __future__ import annotations

import argparse
import socket
from typing import Any

from django.core.checks import Tags
from django.core.management.base import BaseCommand, CommandError, CommandParser


class Command(BaseCommand):
    """Command that answers e-stop, stop and halt over REST, in a process that the pages cannot overload."""

    requires_system_checks = (Tags.security, Tags.compatibility)  # the checks of URLs would import every page
    help = "Answers e-stop, stop and halt beside the web process until it is told to end."

    def add_arguments(self, parser: CommandParser) -> None:
        parser.formatter_class = argparse.ArgumentDefaultsHelpFormatter
        parser.add_argument("--host", default="127.0.0.1", help="address to listen on: that of the web")
        parser.add_argument("--port", type=int, default=8001, help="0 takes a free one")
        parser.add_argument(
            "--web-port", type=int, default=8000, help="port of the web whose pages press here"
        )
        parser.add_argument(
            "--descriptor",
            type=int,
            help="of a socket of a lab that listens already, instead of host and port",
        )
        parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")

    def handle(
        self,
        *args: Any,
        host: str,
        port: int,
        web_port: int,
        descriptor: int | None,
        lifeline: bool,
        **options: Any,
    ) -> None:
        from evaweb.api.stop_gateway import stop_application  # imported here, after the models are loaded
        from evaweb.console import server
        from evaweb.console.connection_limits import StopRequest
        from evaweb.serving.listeners import PortInUseError, open_listener
        from evaweb.serving.stop_port import StopPort

        stop_port = None
        try:
            if descriptor is not None:  # the lab that passed the socket publishes its address itself
                listener = socket.socket(fileno=descriptor)
            else:
                listener = open_listener(host, port)
                stop_port = StopPort(listener.getsockname()[1], web_port)
        except PortInUseError as error:
            raise CommandError(str(error)) from None
        except OSError as error:
            raise CommandError(f"--descriptor {descriptor}: {error.strerror}; allowed: a socket's") from None
        server.serve(
            stop_application(web_port), listener, beside=stop_port, lifeline=lifeline, request=StopRequest
        )
