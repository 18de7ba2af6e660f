"""Limits of REST request bodies by path, in one table: who may send how many bytes and values."""

from __future__ import annotations

import re
from dataclasses import dataclass

from evaweb.accounts.roles import Role

_KIB = 1024


@dataclass(frozen=True, slots=True)
class BodyLimit:
    """Limits of a request body.

    Attributes:
        largest: Limit of its length [bytes].
        values: Limit of the number of its JSON values, which is counted by brackets and commas.
        role: Lowest role whose users may send a body.
    """

    largest: int
    values: int
    role: Role = Role.OPERATOR


_USUAL = BodyLimit(64 * _KIB, 1000)
_OTHERS = tuple(
    (re.compile(f"/api/v1/{path}"), post)
    for path, post in {
        "stations/[^/]+/estop": BodyLimit(
            64 * _KIB, 1000, Role.VIEWER
        ),  # the reason is dropped if the body is larger
        "stations/[^/]+/lease": BodyLimit(
            8 * _KIB, 100, Role.VIEWER
        ),  # a user who has lost the operator role can still release it
        "stations/[^/]+/commands": BodyLimit(256 * _KIB, 10_000),
        "trials/[^/]+/score": BodyLimit(256 * _KIB, 2000),  # three texts of 8000 characters, each escaped
        "datasets/jobs": BodyLimit(1024 * _KIB, 100_000),  # list of episodes of a dataset
    }.items()
)


def body_limit_for(path: str) -> BodyLimit:
    """Return the limits of a POST to `path`."""
    return next((post for pattern, post in _OTHERS if pattern.fullmatch(path)), _USUAL)
