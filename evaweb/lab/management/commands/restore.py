"""`manage.py restore BACKUP`: a backup into an empty data folder and an empty database."""

from __future__ import annotations

from pathlib import Path

from django.core.management import call_command

from evaweb.lab.backups import backup
from evaweb.lab.backups.command import BackupCommand


class Command(BackupCommand):
    """Command that restores a backup, applies this program's migrations, and reconciles database and files."""

    help = "Puts a backup back into the data folder and database of the settings, which have to be empty."

    def work_on(self, path: Path) -> None:
        restored = backup.restore(path, self.stderr.write)
        self.stdout.write(
            f"{restored.path}, made {restored.about['made']}: restored; every file and table compared"
        )
        call_command("migrate", verbosity=0)
        call_command("reconcile")
