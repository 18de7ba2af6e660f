"""Command that creates a token for the REST interface."""

from __future__ import annotations

from typing import Any

from django.contrib.auth.models import User
from django.core.management.base import BaseCommand, CommandError, CommandParser

from evaweb.api.tokens import DAYS, MOST_DAYS, create_token
from evaweb.core.errors import EvaError


class Command(BaseCommand):
    """`manage.py api_token USER NAME`; prints the token, once."""

    help = "Make a token for the REST interface and print it; it cannot be shown again."

    def add_arguments(self, parser: CommandParser) -> None:
        """Declare user, purpose and duration."""
        parser.add_argument("user", help="the username whose rights the token has")
        parser.add_argument("name", help="what uses it, e.g. nightly-export")
        parser.add_argument(
            "--days", type=int, default=DAYS, help=f"how long it is good, 1 to {MOST_DAYS}; otherwise {DAYS}"
        )

    def handle(self, *args: Any, **options: Any) -> None:
        """Print the token and nothing else."""
        user = User.objects.filter(username=options["user"]).first()
        if user is None:
            names = ", ".join(User.objects.values_list("username", flat=True)) or "none yet"
            raise CommandError(f"user {options['user']!r} does not exist; there are: {names}")
        try:
            self.stdout.write(create_token(user=user, name=options["name"], days=options["days"]))
        except EvaError as fault:
            raise CommandError(str(fault)) from None
