"""Concealment of checkpoints: a fresh code for every trial, and a commitment that nothing was changed after.

Codes are of one trial each, because labels that stay are learned. The commitment is shown before the first trial; the
reveal shows the key it was made with, from which anyone computes schedule, codes and commitment again.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Sequence

from evaweb.canonical import digest
from evaweb.errors import EvaError
from evaweb.plans.schedule import Unit
from evaweb.plans.seeded_draws import KEY_BYTES, SeededDraws
from runtime.core.sentences import Pattern

_CODES_ALLOWED = Pattern("plans.commitment.codes_allowed", "{count} codes; allowed: {count_2}")
_KEY_BYTES_ALLOWED = Pattern(
    "plans.commitment.key_bytes_allowed",
    "a key of {count} bytes; allowed: {key_bytes}",
)

_LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789"  # without 0 and O, 1 and I: they are read aloud across a bench
_LENGTH = 5


def draw_codes(key: bytes, count: int) -> list[str]:
    """`count` different codes, in the order of the trials; they say nothing of what they stand for."""
    if count > len(_LETTERS) ** _LENGTH // 100:
        raise EvaError(_CODES_ALLOWED(count=count, count_2=len(_LETTERS) ** _LENGTH // 100))
    chance, found = SeededDraws(key, "codes"), dict[str, None]()
    while len(found) < count:
        found["".join(_LETTERS[chance.below(len(_LETTERS))] for _ in range(_LENGTH))] = None
    return list(found)


def make_commitment(plan: str, units: Sequence[Unit], key: bytes) -> str:
    """Commitment shown before: HMAC-SHA-256 by the key of the plan's and its schedule's digests, in hex.

    With a key of 256 bits it tells nothing of the schedule, and no second schedule has it.
    """
    if len(key) != KEY_BYTES:
        raise EvaError(_KEY_BYTES_ALLOWED(count=len(key), key_bytes=KEY_BYTES))
    return hmac.new(key, f"{plan}\n{schedule_digest(units)}".encode(), hashlib.sha256).hexdigest()


def schedule_digest(units: Sequence[Unit]) -> str:
    """SHA-256 of the canonical form of the schedule."""
    return digest({"units": [unit.row for unit in units]})


def verify_commitment(plan: str, units: Sequence[Unit], key: bytes, committed: str) -> bool:
    """True if plan, schedule and key are those that were committed to."""
    return hmac.compare_digest(make_commitment(plan, units, key), committed)
