"""Progress within trials: funnel of milestones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from evaweb.statistics.base import StatisticsError
from evaweb.statistics.proportions import Proportion, proportion


@dataclass(frozen=True, slots=True)
class FunnelStep:
    """Share of all trials that reached a milestone, and share of those that reached the milestone before it."""

    of_all: Proportion
    of_previous: Proportion


def funnel(reached: Sequence[Sequence[bool]]) -> list[FunnelStep]:
    """Return the funnel step of each milestone; `reached` [trials, milestones] is whether a trial reached it.

    In each step, `of_all` is the share of trials that reached the milestone, and `of_previous` is the same share among
    the trials that reached the previous milestone, whether or not the milestones are ordered.
    """
    if not reached:
        return []
    widths = {len(trial) for trial in reached}
    if len(widths) > 1:
        raise StatisticsError(f"trials with {sorted(widths)} milestones; allowed: the same number in each")
    steps = []
    for i in range(widths.pop()):
        before = [trial for trial in reached if i == 0 or trial[i - 1]]
        steps.append(
            FunnelStep(
                proportion(sum(bool(trial[i]) for trial in reached), len(reached)),
                proportion(sum(bool(trial[i]) for trial in before), len(before)),
            )
        )
    return steps
