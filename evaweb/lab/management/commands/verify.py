"""`manage.py verify BACKUP`: check of a backup against its digests."""

from __future__ import annotations

from pathlib import Path

from evaweb.lab.backups import backup
from evaweb.lab.backups.command import BackupCommand
from evaweb.lab.backups.errors import BackupError


class Command(BackupCommand):
    """Command that reads a complete backup; the exit code is 1 if there are differences, each on a line."""

    help = "Compares a backup's database and files with their digests; needs no lab."

    def work_on(self, path: Path) -> None:
        copy, problems = backup.verify(path, self.stderr.write)
        for problem in problems:
            self.stdout.write(problem)
        if problems:
            raise BackupError(f"{copy.path}: {len(problems)} of its files are not as they were written")
        created, version = copy.about["made"], copy.about["version"]
        self.stdout.write(f"{copy.path}, made {created} by version {version}: as it was written")
