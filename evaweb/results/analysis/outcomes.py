"""One scored trial, as all analyses take it; no Django, so that a report outside of it counts the same."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from evaweb.trials.failure_words import failure_text


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of one trial that counts.

    `order` is when it was run among those of its evaluation, `block` names the initial condition and its repetition:
    trials of one block met the same one. `milestones` are those of its scene in their order. `duration` is in s.
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
    labels: tuple[str, ...] = field(default=())  # of the milestones
    smoothness: float | None = None  # SPARC of the measured motion; None where there is no recording of it
    commanded: float | None = None  # the same of what was sent
    failure_phase: str = ""

    @property
    def why(self) -> str:
        """Phase and cause of a failure, as far as they were said."""
        return failure_text(self.failure_phase, self.failure)

    @property
    def condition(self) -> str:
        """The initial condition, without its repetition."""
        return f"{self.scene}/{self.position}"


@dataclass(frozen=True, slots=True)
class Interruption:
    """A run that was broken off and is not scored: `duration` [s] where it is known."""

    trial: int
    checkpoint: str
    scene: str
    position: int
    duration: float | None = None
    station: str = ""
    operator: str = ""


def by_checkpoint(outcomes: Iterable[Outcome]) -> dict[str, list[Outcome]]:
    """Each checkpoint's, in the order in which they were run."""
    found: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in sorted(outcomes, key=lambda o: o.order):
        found[outcome.checkpoint].append(outcome)
    return dict(sorted(found.items()))


@dataclass(frozen=True, slots=True)
class Pair:
    """The trials of two checkpoints in one block."""

    first: Outcome
    second: Outcome


def pair_by_block(first: Sequence[Outcome], second: Sequence[Outcome]) -> list[Pair]:
    """Both checkpoints' trials, block by block: those of a plan as scheduled, others as they were completed.

    A block in which one of them is missing waits. Of several trials in one block, only the last ones count.
    """
    others = {outcome.block: outcome for outcome in sorted(second, key=lambda o: o.order)}
    ours = {outcome.block: outcome for outcome in sorted(first, key=lambda o: o.order)}
    pairs = [Pair(outcome, others[block]) for block, outcome in ours.items() if block in others]
    return sorted(pairs, key=_place)


def unbroken(pairs: Sequence[Pair]) -> list[Pair]:
    """Pairs of a whole plan, in their order, up to the first of its blocks that lacks one."""
    return [pair for place, pair in enumerate(pairs) if _place(pair) == place]


def _place(pair: Pair) -> int:
    """Its place: the number of its block, which a plan's schedule gives; nobody's choice, whoever finishes first."""
    block = pair.first.block
    return int(block) if block.isdecimal() else max(pair.first.order, pair.second.order)
