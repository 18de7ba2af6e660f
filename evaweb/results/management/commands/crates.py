"""Command for RO-Crates: export of a plan's results, import of those of another lab."""

from __future__ import annotations

import shutil
from argparse import ArgumentParser
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from django.contrib.auth.models import User
from django.core.management.base import BaseCommand, CommandError

from evaweb.core.errors import EvaError
from evaweb.results.crates.export import write_crate
from evaweb.results.crates.imported import import_crate
from evaweb.results.crates.licenses import LICENSES
from evaweb.results.crates.options import CrateOptions
from evaweb.results.selectors import plan_get
from runtime.core.durable_files import creating_durably


class Command(BaseCommand):
    """Command with two parts: `export PLAN --out FILE.zip --license SPDX` and `import FILE.zip --user NAME`."""

    help = "Write the results of a plan as an RO-Crate, or import those of another lab."

    def add_arguments(self, parser: ArgumentParser) -> None:
        """Declare the arguments of each part."""
        parts = parser.add_subparsers(dest="what", required=True)
        export = parts.add_parser("export", help="write the results of a plan as a new zip")
        export.add_argument("plan", help="its name; with /VERSION where it is not the newest one")
        export.add_argument("--out", type=Path, required=True, metavar="FILE.zip", help="a new file")
        export.add_argument(
            "--license", required=True, choices=list(LICENSES), metavar="SPDX", help="its licence"
        )
        export.add_argument(
            "--name", default="", help="of the crate; by default title and version of the plan"
        )
        export.add_argument("--description", default="", help="by default the question of the plan")
        export.add_argument("--lab", default="", help="who publishes it")
        export.add_argument(
            "--date", default="", help="day of publication; by default that of the newest record"
        )
        export.add_argument("--videos", action="store_true", help="with the videos of the trials that count")
        export.add_argument(
            "--sealed",
            action="store_true",
            help="also of a plan that is blind and not yet revealed: whoever reads it runs none of its trials",
        )

        take = parts.add_parser("import", help="check the crate of another lab, and keep it read-only")
        take.add_argument("file", type=Path, metavar="FILE.zip")
        take.add_argument("--user", required=True, help="the administrator who imports it")

    def handle(self, *args: Any, **options: Any) -> None:
        """Carry out the part that was named, and print what it did."""
        try:
            if options["what"] == "import":
                self._import(options["file"], options["user"])
            else:
                self._export(**options)
        except (EvaError, OSError) as error:
            raise CommandError(str(error)) from None

    def _export(self, *, plan: str, out: Path, sealed: bool, **options: Any) -> None:
        name, _, version = plan.partition("/")
        if version and not version.isdecimal():
            raise CommandError(f"version {version!r}; allowed: a number, as in {name}/2")
        row = plan_get(name=name, version=int(version) if version else None)
        if row.sealed and not sealed:
            raise CommandError(f"{row} is blind until it is revealed: --sealed writes its crate all the same")
        if out.exists():
            raise CommandError(f"{out} exists: name a new file")
        chosen = CrateOptions(
            **{field: options[field] for field in ("license", "name", "description", "lab", "date", "videos")}
        )
        with TemporaryFile(dir=out.parent) as draft, creating_durably(out) as file:
            written = write_crate(row, chosen, draft)  # a zip is not written from its beginning to its end
            draft.seek(0)
            shutil.copyfileobj(draft, file)
        absent = f"; {written.absent} videos are not on this machine" if written.absent else ""
        self.stdout.write(f"wrote {out}: {written.files} files, {written.videos} videos{absent}")

    def _import(self, file: Path, name: str) -> None:
        user = User.objects.filter(username=name, is_active=True).first()
        if user is None:
            raise CommandError(f"--user {name}: there is no such user, or the account is switched off")
        with file.open("rb") as content:
            row = import_crate(user=user, file=content)
        self.stdout.write(f"imported {file} as {row.sha256}: its digests agree")
