"""manage.py archive UUID...: moves the videos of recordings to the lab's store, or brings them back."""

from __future__ import annotations

from typing import Any
from uuid import UUID

from django.core.management.base import BaseCommand, CommandError, CommandParser

from evaweb.core.errors import EvaError
from evaweb.episodes.archive import archived_files, bring_back, is_in_use, put_away
from runtime.recording.files import RecordingError


class Command(BaseCommand):
    """Command that moves camera files to the store or back; idempotent, and allowed while the lab runs."""

    help = "Moves the videos of closed recordings to the lab's store (EVA_STORE), or brings them back with --back."

    def add_arguments(self, parser: CommandParser) -> None:
        """Declare the episodes and the direction."""
        parser.add_argument("uuids", nargs="+", type=UUID, metavar="UUID", help="of an episode")
        parser.add_argument("--back", action="store_true", help="bring the videos back from the store")

    def handle(self, *args: Any, uuids: list[UUID], back: bool = False, **options: Any) -> None:
        """Move each episode, and print one line for each. Raises: CommandError if one could not be moved."""
        failed = 0
        for uuid in uuids:
            try:
                self.stdout.write(f"{uuid}: {_brought(uuid) if back else _moved(uuid)}")
            except (EvaError, RecordingError) as error:
                failed += 1
                self.stderr.write(f"{uuid}: {error}")
        if failed:
            raise CommandError(f"{failed} of {len(uuids)} could not be moved")


def _moved(uuid: UUID) -> str:
    if is_in_use(uuid):
        raise RecordingError("a job is at work on it: try again when it is done")
    removed = put_away(uuid)
    return f"in the store, {removed} files removed here" if removed else "in the store already"


def _brought(uuid: UUID) -> str:
    if not archived_files(uuid):
        return "is not in the store: nothing to bring back"
    count = bring_back(uuid)
    return f"{count} files brought back" if count else "is here already"
