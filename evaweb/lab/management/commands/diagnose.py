"""`manage.py diagnose --out FILE.zip`: the diagnostic bundle, without web and worker."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path
from typing import Any

from django.contrib.auth.models import AnonymousUser
from django.core.management.base import BaseCommand, CommandError

from evaweb.blinding.visibility import FULL_VISIBILITY
from evaweb.lab.diagnosis import bundle


class Command(BaseCommand):
    """Command that writes the diagnostic bundle.

    Without --unblinded the bundle contains nothing about blind plans, because the person who reads it may be blind.
    """

    help = "Versions, settings, machine, deployments, stations, jobs and logs of this lab in one file, without secrets."

    def add_arguments(self, parser: ArgumentParser) -> None:
        parser.add_argument("--out", type=Path, required=True, metavar="FILE.zip", help="where to write it")
        parser.add_argument(
            "--unblinded",
            action="store_true",
            help="with logs and all, also while a plan is blind: for a reader who may know",
        )

    def handle(self, *args: Any, **options: Any) -> None:
        path = options["out"].expanduser().absolute()
        visibility = FULL_VISIBILITY if options["unblinded"] else bundle.visibility_for(AnonymousUser())
        try:
            notes = bundle.write(path, visibility, lambda part: self.stderr.write(f"gathering {part}"))
        except OSError as error:
            raise CommandError(
                f"{path}: {error.strerror}; name a file in a folder that can be written"
            ) from None
        for note in notes:
            self.stdout.write(f"not in it: {note}")
        self.stdout.write(f"{path}, {path.stat().st_size:,} bytes: open summary.html in it, or summary.txt")
