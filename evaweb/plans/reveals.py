"""The reveal of a plan on the disk: a database that is put back does not make it undone.

DATA/reveals/UUID.jsonl, named by the first half of the plan's digest. The first line counts, whatever came later. Its
`at_reveal` has who revealed, and the commitment and key of then: a plan that is frozen again has others.
"""

from __future__ import annotations

import logging
from datetime import datetime
from typing import Annotated, Any, Literal
from uuid import UUID

from django.contrib.auth.models import User
from pydantic import Field

from evaweb.journal import Journal, Line, Moment, Person
from evaweb.plans.models import Plan

log = logging.getLogger(__name__)


class RevealLine(Line):
    """A reveal: what of the plan's comparison counts from then on."""

    kind: Literal["reveal"] = "reveal"
    name: str
    version: Annotated[int, Field(ge=1, lt=2**31)]
    digest: str
    at_reveal: dict[str, Any] | None
    by: Person
    at: Moment


REVEALS: Journal[RevealLine] = Journal("reveals", RevealLine)


def first_reveal(plan: Plan) -> RevealLine | None:
    """The first reveal of a frozen plan, of whatever database; None before it."""
    lines = REVEALS.read(_file(plan), log.warning)
    return next((line for line in lines if line.digest == plan.digest), None)


def write_reveal(plan: Plan, user: User, at: datetime) -> None:
    """Write down a reveal, or the close of a plan that is not blind, that is about to be saved, and complete its
    `at_reveal`. Raises NotKept."""
    by = user.get_username()
    if plan.at_reveal is not None:
        key = bytes(plan.key or b"").hex()
        plan.at_reveal = {**plan.at_reveal, "by": by, "commitment": plan.commitment, "key": key}
    REVEALS.append(_file(plan), RevealLine.written(plan, by=by, at=at.isoformat()))


def _file(plan: Plan) -> UUID:
    return UUID(hex=plan.digest[:32])
