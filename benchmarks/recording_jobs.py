"""Enqueue the publication of all finished episodes: `python -m benchmarks.recording_jobs`; prints their uuids.

The data folder is EVA_DATA_DIR.
"""

from __future__ import annotations

import json
import os
import sys


def main() -> None:
    """Create the database if necessary, read the folders into it, and enqueue one job per episode."""
    import django

    os.environ.setdefault("DJANGO_SETTINGS_MODULE", "evaweb.settings")
    django.setup()
    from django.core.management import call_command

    from evaweb.episodes.models import Episode, EpisodeStatus
    from evaweb.episodes.reconcile import reconcile
    from evaweb.episodes.services import request_publish

    call_command("migrate", verbosity=0)
    reconcile()
    closed = Episode.objects.filter(status=EpisodeStatus.FINISHED, frames__gt=0)
    requested = [str(episode.uuid) for episode in closed if request_publish(episode=episode)]
    json.dump(requested, sys.stdout)


if __name__ == "__main__":
    main()
