"""Bounds of posts to REST, by address: the role, how many bytes, how many values; one table for all."""

from __future__ import annotations

import re
from dataclasses import dataclass

from evaweb.roles import Role

_KIB = 1024


@dataclass(frozen=True, slots=True)
class BodyLimit:
    """The bounds of a body: `largest` bytes, `values` counted by their brackets and commas, from `role` on."""

    largest: int
    values: int
    role: Role = Role.OPERATOR


_USUAL = BodyLimit(64 * _KIB, 1000)
_OTHERS = tuple(
    (re.compile(f"/api/v1/{path}"), post)
    for path, post in {
        "stations/[^/]+/estop": BodyLimit(64 * _KIB, 1000, Role.VIEWER),  # beyond it what is said is left out
        "stations/[^/]+/lease": BodyLimit(
            8 * _KIB, 100, Role.VIEWER
        ),  # who is no operator any more gives it up
        "stations/[^/]+/commands": BodyLimit(256 * _KIB, 10_000),
        "trials/[^/]+/score": BodyLimit(256 * _KIB, 2000),  # three texts of 8000 characters, each escaped
        "datasets/jobs": BodyLimit(1024 * _KIB, 100_000),  # which of the episodes of a dataset
    }.items()
)


def body_limit_for(path: str) -> BodyLimit:
    """Bounds of a post to that address of REST."""
    return next((post for pattern, post in _OTHERS if pattern.fullmatch(path)), _USUAL)
