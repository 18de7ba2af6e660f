"""Outcome of one scored trial, the input of all analyses; without Django, so that offline reports compute the same."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from evaweb.trials.failure_text import failure_text


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of one trial that counts.

    `order` is its position among the runs of its evaluation. All trials of one `block` have the same initial condition
    and repetition. `milestones` says of each milestone of the scene, in order, whether it was reached. `duration` is in
    s.
    """

    trial: int
    order: int
    block: str
    checkpoint: str
    scene: str
    position: int
    success: bool
    score: float
    duration: float | None = None
    milestones: tuple[bool, ...] = ()
    failure: str = ""
    station: str = ""
    operator: str = ""
    labels: tuple[str, ...] = field(default=())  # texts of the milestones
    smoothness: float | None = None  # SPARC of the measured motion; None without a recording
    commanded: float | None = None  # SPARC of the sent commands
    failure_phase: str = ""

    @property
    def why(self) -> str:
        """Phase and cause of a failure, as far as specified."""
        return failure_text(self.failure_phase, self.failure)

    @property
    def condition(self) -> str:
        """Initial condition as SCENE/POSITION; all repetitions of it have the same text."""
        return f"{self.scene}/{self.position}"


@dataclass(frozen=True, slots=True)
class Interruption:
    """Run that was interrupted and not scored; `duration` [s] if known."""

    trial: int
    checkpoint: str
    scene: str
    position: int
    duration: float | None = None
    station: str = ""
    operator: str = ""


def by_checkpoint(outcomes: Iterable[Outcome]) -> dict[str, list[Outcome]]:
    """Return the outcomes by checkpoint, in the order of running."""
    outcomes_of: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in sorted(outcomes, key=lambda o: o.order):
        outcomes_of[outcome.checkpoint].append(outcome)
    return dict(sorted(outcomes_of.items()))


@dataclass(frozen=True, slots=True)
class Pair:
    """Trials of two checkpoints in one block."""

    first: Outcome
    second: Outcome


def pair_by_block(first: Sequence[Outcome], second: Sequence[Outcome]) -> list[Pair]:
    """Return for each block with trials of both checkpoints the pair of these trials.

    Pairs are sorted by the schedule's block number if the trials are of a plan, else in the order of completion. Of
    several trials of a checkpoint in one block only the last counts.
    """
    second_by_block = {outcome.block: outcome for outcome in sorted(second, key=lambda o: o.order)}
    first_by_block = {outcome.block: outcome for outcome in sorted(first, key=lambda o: o.order)}
    pairs = [
        Pair(outcome, second_by_block[block])
        for block, outcome in first_by_block.items()
        if block in second_by_block
    ]
    return sorted(pairs, key=_place)


def unbroken(pairs: Sequence[Pair]) -> list[Pair]:
    """Return the pairs before the first incomplete block.

    `pairs` are all pairs of a plan, in the order of its blocks.
    """
    return [pair for place, pair in enumerate(pairs) if _place(pair) == place]


def _place(pair: Pair) -> int:
    """Return the sort key of a pair.

    It is the block number of the schedule, which does not depend on which trial finishes first. Without a schedule it
    is the position of the pair's later trial.
    """
    block = pair.first.block
    return int(block) if block.isdecimal() else max(pair.first.order, pair.second.order)


def count_successes(trials: Sequence[Outcome]) -> tuple[int, int]:
    """Return the number of successes and of trials."""
    return sum(outcome.success for outcome in trials), len(trials)


def grouped(trials: Iterable[Outcome], key: Callable[[Outcome], str]) -> dict[str, list[Outcome]]:
    """Return the trials by key, with the keys in ascending order."""
    groups: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in trials:
        groups[key(outcome)].append(outcome)
    return dict(sorted(groups.items()))


@dataclass(frozen=True, slots=True)
class TimeHorizon:
    """Horizon up to which times to success are compared, and the time limit of each scene.

    `until` [s] is the horizon. A success after the horizon counts like a failure: as not reached within the horizon.
    The horizon is 0 if no trial has a known duration. `limits` maps names of scenes to time limits [s].
    """

    until: float
    limits: Mapping[str, float]

    @classmethod
    def of(cls, outcomes: Sequence[Outcome], limits: Mapping[str, float]) -> TimeHorizon:
        """Return the horizon: the smallest of `limits`, or without limits the duration of the longest run."""
        longest = max((o.duration for o in outcomes if o.duration is not None), default=0.0)
        return cls(min(limits.values(), default=longest), limits)

    def known(self, outcome: Outcome) -> bool:
        """Return True if the trial's duration is known and the horizon is not 0."""
        return outcome.duration is not None and self.until > 0

    def time(self, outcome: Outcome) -> float | None:
        """Return the time to success [s], None for a failure; capped at the scene's limit, because a run ends
        shortly after it.
        """
        if not outcome.success or outcome.duration is None:
            return None
        return min(outcome.duration, self.limits.get(outcome.scene, outcome.duration))

    def time_within_horizon(self, outcome: Outcome) -> float:
        """Return the time to success within the horizon; a failure counts as the horizon."""
        time = self.time(outcome)
        return self.until if time is None else min(time, self.until)
