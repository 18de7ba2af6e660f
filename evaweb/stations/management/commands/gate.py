"""manage.py gate: entrance for stations on other computers."""

from __future__ import annotations

from typing import Any

from django.conf import settings
from django.core.checks import Tags
from django.core.management.base import BaseCommand, CommandError, CommandParser


class Command(BaseCommand):
    """Command that connects stations on other computers, so that the web uses them like local ones."""

    requires_system_checks = (Tags.security, Tags.compatibility)  # the URL checks would import every page
    help = "Lets stations on other computers connect, until it is told to end."

    def add_arguments(self, parser: CommandParser) -> None:
        host, port = settings.EVA_GATE or ("127.0.0.1", 8470)
        parser.add_argument(
            "--host", default=host, help=f"address to listen on (default: {host}, of EVA_GATE)"
        )
        parser.add_argument(
            "--port",
            type=int,
            default=port,
            help=f"of stops and commands; 0 takes a free one (default: {port}, of EVA_GATE)",
        )
        parser.add_argument("--second-port", type=int, help="of pictures (default: the one after --port)")
        parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")

    def handle(
        self, *args: Any, host: str, port: int, second_port: int | None, lifeline: bool, **options: Any
    ) -> None:
        from evaweb.episodes.arriving import owner_of, read_back  # imports models, which need loaded apps
        from evaweb.stations import gate

        if second_port is None:
            second_port = port + 1 if port else 0
        try:
            gate.serve((host, port, second_port), lifeline, owner_of, read_back)
        except gate.GateError as fault:
            raise CommandError(str(fault)) from None
