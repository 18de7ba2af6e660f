"""The order of the trials of a plan: blocks of all checkpoints at one initial condition, at random and balanced.

A block is one initial condition once: every checkpoint is tried there, one after the other, so that each comparison is
made under the same condition at nearly the same time (Kress-Gazit et al. 2024). Rounds go through all conditions before
any is repeated. Within each round of as many blocks as there are checkpoints, each checkpoint comes once at each place.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from evaweb.errors import EvaError
from evaweb.plans.seeded_draws import Chance

MOST = 20_000  # trials of one plan: more is a mistake in the form


@dataclass(frozen=True, slots=True)
class Condition:
    """One initial condition: a position of a scene, by their names in the plan."""

    scene: str
    position: int


@dataclass(frozen=True, slots=True)
class Unit:
    """One trial to be made: the `index`-th of the plan, `place` within its block, `repetition` from 1."""

    index: int
    block: int
    place: int
    checkpoint: str
    condition: Condition
    repetition: int

    @property
    def row(self) -> list[Any]:
        """As it is committed to: index, block, checkpoint, scene, position, repetition."""
        where = self.condition
        return [self.index, self.block, self.checkpoint, where.scene, where.position, self.repetition]


def schedule(
    *, checkpoints: Sequence[str], conditions: Sequence[Condition], repetitions: int, key: bytes
) -> list[Unit]:
    """All trials of a plan in the order in which they are handed out; the same for the same plan and key."""
    _check(checkpoints, conditions, repetitions)
    units: list[Unit] = []
    block = 0
    orders = _orders(list(checkpoints), Chance(key, "orders"))
    for repetition in range(1, repetitions + 1):
        for condition in Chance(key, f"conditions/{repetition}").shuffled(list(conditions)):
            for place, checkpoint in enumerate(next(orders)):
                units.append(Unit(len(units), block, place, checkpoint, condition, repetition))
            block += 1
    return units


def _orders(checkpoints: list[str], chance: Chance) -> Iterator[list[str]]:
    """Orders of the checkpoints, block by block: rows of Latin squares, each drawn anew."""
    k = len(checkpoints)
    while True:
        names = chance.shuffled(checkpoints)
        columns = chance.shuffled(range(k))
        yield from chance.shuffled([[names[(row + column) % k] for column in columns] for row in range(k)])


def _check(checkpoints: Sequence[str], conditions: Sequence[Condition], repetitions: int) -> None:
    for what, items in (("checkpoint", checkpoints), ("condition", conditions)):
        if not items:
            raise EvaError(f"no {what}: a plan needs at least one")
        twice = next((item for item in items if list(items).count(item) > 1), None)
        if twice is not None:
            raise EvaError(f"{what} {twice} is named twice")
    if repetitions < 1:
        raise EvaError(f"repetitions = {repetitions}; allowed: 1 or more")
    total = len(checkpoints) * len(conditions) * repetitions
    if total > MOST:
        raise EvaError(
            f"{len(checkpoints)} checkpoints x {len(conditions)} conditions x {repetitions} repetitions are {total} "
            f"trials; allowed: {MOST}"
        )
