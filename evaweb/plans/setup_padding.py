"""Least durations of a blind trial's set-up stages, so that timing does not reveal its checkpoint.

A stage that waits for the policy lasts at least as long as the longest that it recently took with any checkpoint of
the plan at this station, plus a random time of up to a quarter of that, drawn from the plan's key. Without the
random time, a stage that takes longer than its least duration would reveal the slowest checkpoint.
"""

from __future__ import annotations

from collections.abc import Mapping

from evaweb.plans.models import Handout
from evaweb.plans.seeded_draws import SeededDraws
from evaweb.trials.models import Trial
from evaweb.trials.station_commands import register_min_stage_times

NEWEST = 5  # recent set-ups per checkpoint that count; a server's first one may include a minute of compiling
LONGER = 1.25
MOST_S = 300.0
_STAGES = ("connect_s", "warm_up_s")
_FINE = 10_000  # number of different extensions


def min_stage_times(trial: Trial) -> Mapping[str, float] | None:
    """Return the least duration of each stage of the trial's set-up [s].

    None if the trial is not of a blind plan, or no durations are known yet.
    """
    handout = Handout.objects.select_related("plan").filter(trial=trial).first()
    if handout is None or not handout.plan.sealed:
        return None
    took = [
        row
        for checkpoint in handout.plan.checkpoints.values_list("pk", flat=True)
        for row in Trial.objects.filter(
            station=trial.station_id, checkpoint=checkpoint, setup_took__isnull=False
        )
        .order_by("-pk")
        .values_list("setup_took", flat=True)[:NEWEST]
    ]
    if not took:
        return None
    longest = {stage: max(float(row.get(stage, 0.0)) for row in took) for stage in _STAGES}
    chance = SeededDraws(bytes(handout.plan.key or b""), f"set-up/{handout.number}")
    return {
        stage: min(MOST_S, seconds * (1 + (LONGER - 1) * chance.below(_FINE) / _FINE))
        for stage, seconds in longest.items()
    }


register_min_stage_times(min_stage_times)
