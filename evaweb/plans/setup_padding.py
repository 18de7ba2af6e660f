"""Least duration of a blind trial's set-up, so that a watch does not tell which checkpoint it is of.

The stages that wait for the policy last as long as they lately did with the slowest of the plan's checkpoints at this
station, and up to a quarter longer, drawn by the plan's key: the slowest is not the one that overruns.
"""

from __future__ import annotations

from collections.abc import Mapping

from evaweb.plans.models import Handout
from evaweb.plans.seeded_draws import SeededDraws
from evaweb.trials.models import Trial
from evaweb.trials.station_commands import register_min_stage_times

NEWEST = 5  # set-ups of a checkpoint that count: the first of a server may have compiled for a minute
LONGER = 1.25
MOST_S = 300.0
_STAGES = ("connect_s", "warm_up_s")
_FINE = 10_000  # different lengths


def min_stage_times(trial: Trial) -> Mapping[str, float] | None:
    """Of each stage of the trial's set-up [s]; None where nothing is blind, or nothing is known yet."""
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
