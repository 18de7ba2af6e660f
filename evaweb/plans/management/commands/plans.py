"""manage.py plans: import and export of scenes, checkpoints and plans."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from django.contrib.auth.models import User
from django.core.management.base import BaseCommand, CommandError, CommandParser

from evaweb.core.errors import EvaError
from evaweb.plans.models import Plan
from evaweb.plans.references import unpacked
from evaweb.plans.toml_exchange import export_archive, export_toml, import_file
from evaweb.trials.models import Checkpoint, Scene


class Command(BaseCommand):
    """Command with two forms.

    `import FILE --user NAME` imports a file, `export [NAME ...] [--archive FILE.zip]` writes one.
    """

    help = (
        "Imports and exports scenes, checkpoints and plans as TOML, or with reference pictures as an archive."
    )

    def add_arguments(self, parser: CommandParser) -> None:
        parts = parser.add_subparsers(dest="what", required=True)
        take = parts.add_parser("import", help="take a file, whole or not at all")
        take.add_argument("file", type=Path, help="- for standard input")
        take.add_argument("--user", required=True, help="the administrator who takes it, and owns its plans")
        give = parts.add_parser("export", help="write plans with all that they are made of")
        give.add_argument("names", nargs="*", help="of plans; none: every scene, checkpoint and plan")
        give.add_argument(
            "--archive", type=Path, help="a zip to write, with the reference pictures of positions"
        )

    def handle(self, *args: Any, **options: Any) -> None:
        try:
            if options["what"] == "import":
                self._import(options["file"], options["user"])
            else:
                self._export(options["names"], options["archive"])
        except EvaError as error:
            raise CommandError(str(error)) from error

    def _import(self, file: Path, name: str) -> None:
        user = User.objects.filter(username=name).first()
        if user is None:
            raise CommandError(f"--user {name}: there is no such user")
        try:
            content = sys.stdin.buffer.read() if str(file) == "-" else file.read_bytes()
        except OSError as error:
            raise CommandError(f"{file}: {error}") from error
        text, pictures = unpacked(content)
        for line in import_file(user=user, text=text, pictures=pictures):
            self.stdout.write(line)

    def _export(self, names: list[str], archive: Path | None) -> None:
        newest = {plan.name: plan for plan in Plan.objects.order_by("version")}
        unknown = [name for name in names if name not in newest]
        if unknown:
            raise CommandError(
                f"plan {unknown[0]} does not exist; there are: {', '.join(newest) or 'none yet'}"
            )
        chosen: dict[str, Any] = {"plans": [newest[name] for name in names or newest]}
        if not names:
            chosen |= {"scenes": list(Scene.objects.all()), "checkpoints": list(Checkpoint.objects.all())}
        if archive is None:
            self.stdout.write(export_toml(**chosen))
            return
        try:
            archive.write_bytes(export_archive(**chosen))
        except OSError as error:
            raise CommandError(f"{archive}: {error}") from error
