"""manage.py reconcile: synchronises the database with the data folder."""

from __future__ import annotations

from typing import Any

from django.core.management.base import BaseCommand

from evaweb.episodes.reconcile import reconcile


class Command(BaseCommand):
    """Command that updates the database from the data folder; idempotent, and allowed while the lab runs."""

    help = "Makes the database say what the data folder holds: episodes, datasets, scores."

    def handle(self, *args: Any, **options: Any) -> None:
        report = reconcile()
        for problem in report.problems:
            self.stderr.write(self.style.WARNING(problem))
        self.stdout.write(
            f"{report.episodes} episodes read, {report.made} of them new to the database; "
            f"{report.missing} missing on this disk; {report.published} in datasets; "
            f"{report.restored} trials and verdicts restored; {len(report.problems)} problems"
        )
