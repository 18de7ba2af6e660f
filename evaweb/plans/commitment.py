"""Concealment of checkpoints: a new code for every trial, and a commitment to the schedule.

Codes are for one trial each, because operators would learn permanent labels. The commitment is published before the
first trial; the reveal publishes its key, from which anyone can recompute schedule, codes and commitment.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Sequence

from evaweb.core.canonical_json import digest
from evaweb.core.errors import EvaError
from evaweb.plans.schedule import Unit
from evaweb.plans.seeded_draws import KEY_BYTES, SeededDraws
from runtime.core.sentences import Pattern

_CODES_ALLOWED = Pattern("plans.commitment.codes_allowed", "{count} codes; allowed: {count_2}")
_KEY_BYTES_ALLOWED = Pattern(
    "plans.commitment.key_bytes_allowed",
    "a key of {count} bytes; allowed: {key_bytes}",
)

_LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789"  # without 0, O, 1 and I, as codes are read aloud
_LENGTH = 5


def draw_codes(key: bytes, count: int) -> list[str]:
    """Return `count` distinct codes in the order of the trials, independent of their checkpoints."""
    if count > len(_LETTERS) ** _LENGTH // 100:
        raise EvaError(_CODES_ALLOWED(count=count, count_2=len(_LETTERS) ** _LENGTH // 100))
    chance, codes = SeededDraws(key, "codes"), dict[str, None]()
    while len(codes) < count:
        codes["".join(_LETTERS[chance.below(len(_LETTERS))] for _ in range(_LENGTH))] = None
    return list(codes)


def make_commitment(plan: str, units: Sequence[Unit], key: bytes) -> str:
    """Return the commitment in hexadecimal: the HMAC-SHA-256, with `key`, of the digests of plan and schedule.

    `plan` is the digest of the plan. With a key of 256 bits the commitment reveals nothing about the schedule, and no
    other schedule matches it.
    """
    if len(key) != KEY_BYTES:
        raise EvaError(_KEY_BYTES_ALLOWED(count=len(key), key_bytes=KEY_BYTES))
    return hmac.new(key, f"{plan}\n{schedule_digest(units)}".encode(), hashlib.sha256).hexdigest()


def schedule_digest(units: Sequence[Unit]) -> str:
    """Return the SHA-256 of the canonical form of the schedule."""
    return digest({"units": [unit.row for unit in units]})


def verify_commitment(plan: str, units: Sequence[Unit], key: bytes, committed: str) -> bool:
    """Return True if plan, schedule and key match the commitment."""
    return hmac.compare_digest(make_commitment(plan, units, key), committed)
