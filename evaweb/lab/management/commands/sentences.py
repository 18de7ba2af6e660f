"""manage.py sentences [FILE]: print all sentences for a translator, or what the file of a language lacks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from django.core.management.base import BaseCommand, CommandError, CommandParser

from evaweb.core.languages import parse
from evaweb.lab import sentences


class Command(BaseCommand):
    """Command that prints all sentences of the product as JSON, or compares the file of a language with them."""

    help = (
        "Prints id, English pattern and arguments of every sentence as JSON. With the FILE of a language it prints "
        "which ids are missing, unknown, or have other arguments, and fails for the last two."
    )

    def add_arguments(self, parser: CommandParser) -> None:
        """Declare the file of a language."""
        parser.add_argument(
            "file", nargs="?", type=Path, help="of a language, such as static/languages/de.json"
        )

    def handle(self, *args: Any, file: Path | None = None, **options: Any) -> None:
        """Print all sentences, or how the file of a language differs from them."""
        entries = {
            "sentences": sentences.once(
                [*sentences.of_python(), *sentences.of_labels(), *sentences.of_scripts()]
            ),
            "templates": sentences.of_templates(),
        }
        if file is None:
            self.stdout.write(
                json.dumps(
                    {part: sentences.catalogue(rows) for part, rows in entries.items()},
                    indent=1,
                    ensure_ascii=False,
                )
            )
            return
        try:
            spoken = parse(file.stem, file.read_text("utf-8"))
        except (OSError, ValueError) as error:
            raise CommandError(f"{file}: {error}") from None
        parts = {
            "sentences": sentences.compared(entries["sentences"], spoken.patterns),
            "templates": sentences.compared(entries["templates"], spoken.templates),
        }
        self.stdout.write(json.dumps(parts, indent=1))
        if any(part["unknown"] or part["other_arguments"] for part in parts.values()):
            raise CommandError(f"{file}: sentences that are unknown, or have other arguments")
