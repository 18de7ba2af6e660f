"""Who rates which trial again, and which of two trials somebody is asked to prefer: never knowing the checkpoint."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from django.contrib.auth.models import User
from django.db import IntegrityError, transaction
from django.db.models import Exists, OuterRef, QuerySet

from evaweb.episodes.models import EpisodeStatus
from evaweb.errors import Conflict, EvaError, NotAllowed, NotFound
from evaweb.plans.chance import Chance
from evaweb.plans.models import Handout, Plan, PlanState
from evaweb.plans.sight import has_looked
from evaweb.results.models import Preference, Rating
from evaweb.roles import Role, require
from evaweb.trials.models import Score, TrialStatus
from evaweb.trials.verdicts import LONGEST_FAILURE, LONGEST_NOTE, verdict

_STATES = (PlanState.FROZEN, PlanState.CLOSED, PlanState.REVEALED)


@dataclass(frozen=True, slots=True)
class Pair:
    """Two trials that were run one after the other at the same initial condition, in that order."""

    plan: Plan
    first: Handout
    second: Handout


def sample_of(plan: Plan) -> list[int]:
    """The places in the schedule whose trials are rated again, in the order in which they are; drawn by the key."""
    n = plan.slots.count()
    drawn = Chance(bytes(plan.key or b""), "second rater").shuffled(range(n))
    return drawn[: math.ceil(plan.second_rater_share * n)]


def to_rate(user: User) -> tuple[Handout | None, int]:
    """The next trial that this user may rate again, and how many there are."""
    found: Handout | None = None
    left = 0
    for plan in Plan.objects.filter(state__in=_STATES, second_rater_share__gt=0).order_by("pk"):
        if has_looked(plan, user):
            continue
        open_ones = {handout.slot.index: handout for handout in _unrated(plan, user)}
        mine = [open_ones[index] for index in sample_of(plan) if index in open_ones]
        left += len(mine)
        found = found or next(iter(mine), None)
    return found, left


def _unrated(plan: Plan, user: User) -> QuerySet[Handout]:
    rated = Rating.objects.filter(trial=OuterRef("trial"))
    scored_by_me = Score.objects.filter(trial=OuterRef("trial"), rater=user)
    rows = plan.handouts.filter(trial__status=TrialStatus.SCORED, trial__episode__isnull=False)
    rows = rows.exclude(trial__episode__status=EpisodeStatus.MISSING)  # it would be asked for ever
    rows = rows.exclude(trial__operator=user).exclude(Exists(rated)).exclude(Exists(scored_by_me))
    return rows.select_related("slot", "plan", "trial__scene", "trial__episode")


@transaction.atomic
def rate(
    *,
    user: User,
    plan: Plan,
    code: str,
    milestones: Mapping[object, object],
    success: bool | None = None,
    failure: str = "",
    note: str = "",
) -> Rating:
    """Keep what somebody who did not run the trial of that code saw on its video."""
    require(user, Role.OPERATOR)
    handout = _handout(plan, code)
    trial = handout.trial
    if handout.slot.index not in sample_of(plan) or trial.status != TrialStatus.SCORED:
        raise Conflict(f"trial {code} of {plan} is not one of those that are rated again")
    if trial.operator_id == user.pk or trial.scores.filter(rater=user).exists():
        raise NotAllowed(f"you ran or scored trial {code}: somebody else rates it again")
    if has_looked(plan, user):
        raise NotAllowed(f"you have seen results of {plan}: a second rater must not know them")
    found = verdict(list(trial.scene.milestones.order_by("order")), milestones, success)
    if len(note) > LONGEST_NOTE or len(failure) > LONGEST_FAILURE:
        raise EvaError(
            f"note or failure is too long; allowed: {LONGEST_NOTE} and {LONGEST_FAILURE} characters"
        )
    return _once(
        Rating(
            trial=trial,
            rater=user,
            success=found.success,
            score=found.score,
            milestones=[[row[0].text, row[1]] for row in found.reached],
            failure=failure.strip(),
            note=note.strip(),
            blind=plan.sealed,
        ),
        f"you have rated trial {code} already",
    )


def to_prefer(user: User, plans: Iterable[Plan] | None = None) -> tuple[Pair | None, int]:
    """The next two trials that this user has not compared, and how many pairs there are."""
    found: Pair | None = None
    left = 0
    for plan in plans if plans is not None else Plan.objects.filter(state__in=_STATES).order_by("pk"):
        if has_looked(plan, user):
            continue
        judged = set(Preference.objects.filter(plan=plan, rater=user).values_list("first", "second"))
        fresh = [pair for pair in _pairs(plan) if pair not in judged]
        left += len(fresh)
        if found is None and fresh:
            found = _pair(plan, *fresh[0])
    return found, left


def _pairs(plan: Plan) -> list[tuple[int, int]]:
    """Trials that are next to each other in one block, both counting and recorded on this disk."""
    rows = plan.handouts.filter(trial__status=TrialStatus.SCORED, trial__episode__isnull=False)
    blocks: dict[int, list[tuple[int, str]]] = defaultdict(list)
    of_each = rows.order_by("number").values_list("slot__block", "trial", "trial__episode__status")
    for block, trial, status in of_each:
        blocks[block].append((trial, status))
    gone = EpisodeStatus.MISSING
    neighbours = (pair for block in blocks.values() for pair in pairwise(block))
    return [(one, other) for (one, at), (other, there) in neighbours if gone not in (at, there)]


def _pair(plan: Plan, first: int, second: int) -> Pair:
    rows = {
        row.trial_id: row
        for row in plan.handouts.filter(trial__in=(first, second)).select_related(
            "trial__episode", "trial__scene", "trial__position"
        )
    }
    return Pair(plan, rows[first], rows[second])


@transaction.atomic
def prefer(*, user: User, plan: Plan, first: str, second: str, outcome: str, why: str) -> Preference:
    """Keep which of the trials of these codes was the better one; the first is the one that was run first."""
    require(user, Role.OPERATOR)
    if outcome not in Preference.Outcome.values:
        raise EvaError(f"outcome = {outcome!r:.80}; allowed: {', '.join(Preference.Outcome.values)}")
    reason = why.strip()
    if not reason or len(reason) > LONGEST_NOTE:
        raise EvaError(f"why is {'too long' if reason else 'empty'}: say it in a sentence, others read it")
    if has_looked(plan, user):
        raise NotAllowed(f"you have seen results of {plan}: who prefers must not know them")
    one, other = _handout(plan, first), _handout(plan, second)
    if (one.trial_id, other.trial_id) not in _pairs(plan):
        raise Conflict(f"{first} and {second} were not run one after the other at the same initial condition")
    return _once(
        Preference(
            plan=plan,
            first=one.trial,
            second=other.trial,
            rater=user,
            outcome=outcome,
            why=reason,
            blind=plan.sealed,
        ),
        f"you have compared {first} and {second} already",
    )


def _handout(plan: Plan, code: str) -> Handout:
    found = plan.handouts.select_related("slot", "trial__scene").filter(code=code).first()
    if found is None:
        raise NotFound(f"{plan} has no trial {code!r:.20}")
    return found


def _once(row: Any, twice: str) -> Any:
    try:
        with transaction.atomic():
            row.save()
    except IntegrityError:
        raise Conflict(twice) from None
    return row
