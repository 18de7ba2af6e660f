"""Setting of a result: robot, simulated or real, scenes, dates, and scorers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from django.db.models import Count, Max, Min

from evaweb.plans.models import Plan
from evaweb.trials.models import Score, TrialStatus


def setting_of(plan: Plan) -> str:
    """Return a sentence on the trials that count, as recorded at the reveal or as of now; "" without trials."""
    stored = (plan.at_reveal or {}).get("setting")
    return setting_now(plan) if stored is None else str(stored)


def setting_now(plan: Plan) -> str:
    """Return the current setting of the result as a sentence, with dates in UTC; "" without trials."""
    station, verdict = "trial__station__", "trial__verdict__"
    groups = plan.handouts.filter(trial__status=TrialStatus.SCORED).order_by()
    rows = list(
        groups.values_list(
            *(f"{station}{name}" for name in ("robot", "simulated", "name")),
            *(f"{verdict}{name}" for name in ("rater__username", "source")),
            "trial__truth__benchmark",
        ).annotate(n=Count("pk"), first=Min("trial__prepared_at"), last=Max("trial__prepared_at"))
    )
    if not rows:
        return ""
    robots, stations, scorers = set(), set(), defaultdict[str, int](int)
    for robot, simulated, at, rater, source, benchmark, n, *_ in rows:
        mode = ", in benchmark mode" if benchmark else ""
        robots.add(f"{robot} ({'simulated' if simulated else 'real'}{mode})")
        stations.add(at)
        scorers["the simulated bench" if source == Score.Source.TRUTH else rater] += n
    count = sum(scorers.values())
    days = sorted({f"{min(row[-2] for row in rows):%Y-%m-%d}", f"{max(row[-1] for row in rows):%Y-%m-%d}"})
    scenes = [f'{scene["title"]}, "{scene["instruction"]}"' for scene in (plan.document or {})["scenes"]]
    return (
        f"{count} trial{'s' if count > 1 else ''} on {_and(robots)} at {_and(stations)}, {' to '.join(days)}; "
        f"{'; '.join(scenes)}; scored by {_and(f'{scorer} ({n})' for scorer, n in scorers.items())}"
    )


def _and(parts: Iterable[str]) -> str:
    ordered = sorted(parts)
    return " and ".join(filter(None, (", ".join(ordered[:-1]), ordered[-1])))
