"""Order of a plan's trials: blocks at one initial condition each, randomised and balanced.

Paired: a block tries every checkpoint once in succession, so that each comparison is made under the same condition at
nearly the same time (Kress-Gazit et al. 2024). Rounds cover all conditions before any is repeated. The order within
each block is drawn independently, so that earlier blocks reveal nothing about it. (Plans up to format 5 used rows of
Latin squares, in which one recognised trial revealed parts of later blocks.)

Random: a block has two trials. A fair coin decides for each trial which of the two checkpoints it tries. If one of them
is `IMBALANCE` trials behind at this initial condition, it comes next without a coin (the big stick design, Soares and
Wu 1983). Therefore only few trials are predictable.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from evaweb.core.errors import EvaError
from evaweb.plans.seeded_draws import SeededDraws
from runtime.core.sentences import Pattern

_NO_PLAN_NEEDS_AT_LEAST = Pattern(
    "plans.schedule.no_plan_needs_at_least",
    "no {what}: a plan needs at least one",
)
_NAMED_TWICE = Pattern("plans.schedule.named_twice", "{what} {twice} is named twice")
_REPETITIONS_ALLOWED_1_MORE = Pattern(
    "plans.schedule.repetitions_allowed_1_more",
    "repetitions = {repetitions}; allowed: 1 or more",
)
_CHECKPOINTS_RANDOM_ORDER_ALLOWED_2 = Pattern(
    "plans.schedule.checkpoints_random_order_allowed_2",
    "{count} checkpoints in random order; allowed: 2",
)
_BLOCKS_CHECKPOINTS_RANDOM_ORDER_ALLOWED = Pattern(
    "plans.schedule.blocks_checkpoints_random_order_allowed",
    "{count} blocks of checkpoints in random order; allowed: {least} or more",
)
_CHECKPOINTS_X_CONDITIONS_X_REPETITIONS = Pattern(
    "plans.schedule.checkpoints_x_conditions_x_repetitions",
    "{count} checkpoints x {count_2} conditions x {repetitions} repetitions are {total} trials; "
    "allowed: {most}",
)

MOST = 20_000  # trials per plan; more is a mistake in the form
IMBALANCE = (
    3  # greatest lead of one checkpoint at a condition [trials]; with 3, one of six trials is determined
)
PAIRED, RANDOM = "paired", "random"
_LEAST = 5  # least number of blocks in random order; fewer may contain only one checkpoint


@dataclass(frozen=True, slots=True)
class Condition:
    """Initial condition: a position of a scene, by their names in the plan."""

    scene: str
    position: int


@dataclass(frozen=True, slots=True)
class Unit:
    """Scheduled trial: the `index`-th of the plan, at `place` within its block, `repetition` from 1."""

    index: int
    block: int
    place: int
    checkpoint: str
    condition: Condition
    repetition: int

    @property
    def row(self) -> list[Any]:
        """Row for the commitment: index, block, checkpoint, scene, position, repetition."""
        where = self.condition
        return [self.index, self.block, self.checkpoint, where.scene, where.position, self.repetition]


def schedule(
    *,
    checkpoints: Sequence[str],
    conditions: Sequence[Condition],
    repetitions: int,
    key: bytes,
    allocation: str = PAIRED,
    latin: bool = False,
) -> list[Unit]:
    """Return all trials of a plan in order of handout; deterministic for a plan and key.

    `latin`: use the scheme of plans up to format 5.
    """
    check_schedule(checkpoints, conditions, repetitions, allocation)
    units: list[Unit] = []
    block = 0
    orders = (_latin if latin else _orders)(list(checkpoints), SeededDraws(key, "orders"))
    drawn = _Coins(list(checkpoints), SeededDraws(key, "allocation"))
    for repetition in range(1, repetitions + 1):
        for condition in SeededDraws(key, f"conditions/{repetition}").shuffled(list(conditions)):
            arms = next(orders) if allocation == PAIRED else [drawn.next(condition) for _ in range(2)]
            for place, checkpoint in enumerate(arms):
                # The number must not reveal that a block has one checkpoint twice.
                number = repetition if allocation == PAIRED else 2 * repetition - 1 + place
                units.append(Unit(len(units), block, place, checkpoint, condition, number))
            block += 1
    return units


class _Coins:
    """Random allocation of two checkpoints, trial by trial."""

    def __init__(self, checkpoints: list[str], chance: SeededDraws) -> None:
        self._checkpoints, self._chance = checkpoints, chance
        self._ahead: dict[Condition, int] = {}

    def next(self, condition: Condition) -> str:
        """Return the checkpoint of the next trial at a condition.

        A fair coin decides. But if one checkpoint is IMBALANCE trials behind the other at this condition, it is the
        next.
        """
        ahead = self._ahead.get(condition, 0)  # lead of the first checkpoint
        second = ahead == IMBALANCE or (ahead > -IMBALANCE and self._chance.below(2) == 1)
        self._ahead[condition] = ahead + (-1 if second else 1)
        return self._checkpoints[second]


def counts_of(units: Sequence[Unit], names: Sequence[str]) -> list[tuple[int, int]]:
    """Return, for each block, how many trials both checkpoints have had by its end.

    `units` are the scheduled trials in order, and `names` are the names of the two checkpoints.
    """
    counts: list[tuple[int, int]] = []
    for unit in units:
        if unit.block == len(counts):
            counts.append(counts[-1] if counts else (0, 0))
        first, second = counts[-1]
        counts[-1] = (first + (unit.checkpoint == names[0]), second + (unit.checkpoint == names[1]))
    return counts


def _orders(checkpoints: list[str], chance: SeededDraws) -> Iterator[list[str]]:
    """Yield an independently drawn order of the checkpoints for each block."""
    while True:
        yield chance.shuffled(checkpoints)


def foretold(checkpoints: int, allocation: str) -> str:
    """Return as text how many trials can be predicted despite blinding, and which.

    It is assumed that the operator recognises every checkpoint.
    """
    share = checkpoints if allocation == PAIRED else 2 * IMBALANCE
    which = (
        "the last trial of each block"
        if allocation == PAIRED
        else "a trial where one is as far ahead as may be"
    )
    return f"1 of {share} trials: {which}"


def _latin(checkpoints: list[str], chance: SeededDraws) -> Iterator[list[str]]:
    """Yield an order of the checkpoints for each block: rows of randomly drawn Latin squares."""
    k = len(checkpoints)
    while True:
        names = chance.shuffled(checkpoints)
        columns = chance.shuffled(range(k))
        yield from chance.shuffled([[names[(row + column) % k] for column in columns] for row in range(k)])


def check_schedule(
    checkpoints: Sequence[str], conditions: Sequence[Condition], repetitions: int, allocation: str
) -> None:
    """Raise EvaError if there can be no schedule with these parameters."""
    for kind, items in (("checkpoint", checkpoints), ("condition", conditions)):
        if not items:
            raise EvaError(_NO_PLAN_NEEDS_AT_LEAST(what=kind))
        repeated = next((item for item in items if list(items).count(item) > 1), None)
        if repeated is not None:
            raise EvaError(_NAMED_TWICE(what=kind, twice=repeated))
    if repetitions < 1:
        raise EvaError(_REPETITIONS_ALLOWED_1_MORE(repetitions=repetitions))
    if allocation == RANDOM and len(checkpoints) != 2:
        raise EvaError(_CHECKPOINTS_RANDOM_ORDER_ALLOWED_2(count=len(checkpoints)))
    if allocation == RANDOM and len(conditions) * repetitions < _LEAST:
        raise EvaError(
            _BLOCKS_CHECKPOINTS_RANDOM_ORDER_ALLOWED(count=len(conditions) * repetitions, least=_LEAST)
        )
    total = len(checkpoints) * len(conditions) * repetitions
    if total > MOST:
        raise EvaError(
            _CHECKPOINTS_X_CONDITIONS_X_REPETITIONS(
                count=len(checkpoints),
                count_2=len(conditions),
                repetitions=repetitions,
                total=total,
                most=MOST,
            )
        )
