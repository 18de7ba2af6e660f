"""Reveals of plans on disk, so that a restored database backup cannot undo them.

The file of a plan is DATA/reveals/UUID.jsonl; the UUID is the first half of the plan's digest. Its first line counts,
whatever follows. `at_reveal` in the line has user, commitment and key as they were at the reveal, because a plan that
is frozen again gets another commitment and key.
"""

from __future__ import annotations

import logging
from datetime import datetime
from typing import Annotated, Any, Literal
from uuid import UUID

from django.contrib.auth.models import User
from pydantic import Field

from evaweb.plans.models import Plan
from evaweb.records.journal import (
    Journal,
    Line,
    Moment,
    Person,
)

log = logging.getLogger(__name__)


class RevealLine(Line):
    """Journal line of a plan's reveal, with the result that counts from then on."""

    kind: Literal["reveal"] = "reveal"
    name: str
    version: Annotated[int, Field(ge=1, lt=2**31)]
    digest: str
    at_reveal: dict[str, Any] | None
    by: Person
    at: Moment


REVEALS: Journal[RevealLine] = Journal("reveals", RevealLine)


def first_reveal(plan: Plan) -> RevealLine | None:
    """Return the first reveal of a frozen plan, whichever database wrote it; None if it was never revealed."""
    lines = REVEALS.read(_file(plan), log.warning)
    return next((line for line in lines if line.digest == plan.digest), None)


def write_reveal(plan: Plan, user: User, at: datetime) -> None:
    """Write the journal line of a reveal, or of the close of an open plan.

    The function adds user, commitment and key to `plan.at_reveal`. It must be called before the plan's row is saved.

    Raises:
        NotWritten: If the line could not be written.
    """
    by = user.get_username()
    if plan.at_reveal is not None:
        key = bytes(plan.key or b"").hex()
        plan.at_reveal = {**plan.at_reveal, "by": by, "commitment": plan.commitment, "key": key}
    REVEALS.append(_file(plan), RevealLine.written(plan, by=by, at=at.isoformat()))


def _file(plan: Plan) -> UUID:
    return UUID(hex=plan.digest[:32])
