"""Page that lists many episodes: `python -m benchmarks.recording_listing COUNT`; prints JSON.

EVA_DATA_DIR is a separate folder; requests pass through all layers of the web.
"""

from __future__ import annotations

import json
import os
import random
import statistics
import sys
import time
from datetime import timedelta
from typing import Any

_AGAIN = 7
_WORDS = ("stack", "pour", "fold", "sweep", "place", "open", "close", "insert")
FILTERS = {
    "all": "",
    "last page": "page=200",
    "station": "station=bench-2",
    "mode and status": "mode=continuous&status=finished",
    "one word": "words=stack",
    "three words": "words=stack+red+anna",
    "station, mode, status, words": "station=bench-1&mode=continuous&status=interrupted&words=pour+blue",
    "nothing found": "words=absent",
}


def main(count: int) -> None:
    """Print for each filter the median duration of seven requests [ms]."""
    import django

    os.environ.setdefault("DJANGO_SETTINGS_MODULE", "evaweb.settings")
    django.setup()
    from django.contrib.auth import get_user_model
    from django.core.management import call_command
    from django.test import Client

    call_command("migrate", verbosity=0)
    _fill(count)
    user = get_user_model().objects.create_superuser("bench", password="bench")
    page = Client(HTTP_HOST="localhost")
    page.force_login(user)
    rows = []
    for name, query in FILTERS.items():
        took = [_request(page, query) for _ in range(_AGAIN + 1)][1:]  # the first request compiles templates
        walls, used = zip(*took, strict=True)
        rows.append(
            {
                "filter": name,
                "median_ms": statistics.median(walls),
                "worst_ms": max(walls),
                "processor_ms": statistics.median(used),
            }
        )
    print(json.dumps({"count": count, "rows": rows}))


def _request(page: Any, query: str) -> tuple[float, float]:
    """Return wall time and processor time of a request [ms]."""
    begun, used = time.perf_counter(), time.process_time()
    answer = page.get(f"/replay/?{query}")
    took = (time.perf_counter() - begun) * 1000.0, (time.process_time() - used) * 1000.0
    if answer.status_code != 200:
        raise SystemExit(f"/replay/?{query} answered {answer.status_code}")
    return took


def _fill(count: int) -> None:
    """Create playable episodes of three stations, with all modes and results; half of them belong to trials."""
    from django.utils import timezone

    from evaweb.episodes.folders import preview_folder
    from evaweb.episodes.models import Episode, EpisodeMode, EpisodeStatus
    from evaweb.stations.models import Station

    drawn = random.Random(7)
    stations = [Station.objects.create(name=f"bench-{n}", robot="agilex_piper", title="") for n in (1, 2, 3)]
    now = timezone.now()
    episodes = Episode.objects.bulk_create(
        Episode(
            station=drawn.choice(stations),
            status=drawn.choice(
                [EpisodeStatus.FINISHED] * 8 + [EpisodeStatus.INTERRUPTED, EpisodeStatus.FAILED]
            ),
            mode=drawn.choice(EpisodeMode.values),
            kind=drawn.choice(("rollout", "demonstration")),
            task=f"{drawn.choice(_WORDS)} the {drawn.choice(('red', 'green', 'blue'))} block",
            robot="agilex_piper",
            checkpoint=f"pick-place-{drawn.randrange(40)}k",
            operator=drawn.choice(("anna", "ben", "chris")),
            cameras=["cam_high", "cam_left_wrist", "cam_right_wrist"],
            fps=30.0,
            frames=900,
            duration_s=30.0,
            started_at=now - timedelta(minutes=number),
        )
        for number in range(count)
    )
    for episode in episodes:
        preview_folder(episode.uuid).mkdir(parents=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))
