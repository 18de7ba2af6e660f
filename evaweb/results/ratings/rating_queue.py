"""Selection of trials to rate again, and of pairs to compare, for each rater, without revealing checkpoints."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, tee
from typing import Any, Generic, NamedTuple, TypeVar

from django.contrib.auth.models import User
from django.db import IntegrityError, transaction
from django.db.models import Exists, OuterRef, QuerySet

from evaweb.accounts.roles import Role, require_role, role_of
from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotAllowed,
    NotFound,
)
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.plans.blinding_rules import has_looked_at_the_same
from evaweb.plans.models import Handout, Plan, PlanState
from evaweb.plans.seeded_draws import SeededDraws
from evaweb.records.journal import clean_text
from evaweb.results.models import Preference, Rating
from evaweb.results.ratings.footage import is_watchable, may_become_watchable, require_video
from evaweb.results.ratings.record import RATINGS, PreferenceLine, RatingLine
from evaweb.reviews.selectors import still_judges
from evaweb.trials import failures
from evaweb.trials.models import Score, Trial, TrialStatus
from evaweb.trials.record import journal_uuid
from evaweb.trials.scoring import LONGEST_NOTE, score_outcome
from evaweb.trials.services import failing, register_check, run_checks
from runtime.core.sentences import Pattern, fixed

_TRIAL_RATED_BY_SECOND_PERSON = Pattern(
    "results.ratings.judging.trial_rated_by_second_person",
    "trial {trial} is to be rated by a second person, and that may be you: rate it first (Result, Second ratings), "
    "then correct its score",
)
_TRIAL_NOT_ONE_THOSE_RATED = Pattern(
    "results.ratings.judging.trial_not_one_those_rated",
    "trial {code} of {plan} is not one of those that are rated again",
)
_YOU_RAN_SCORED_TRIAL_SOMEONE = Pattern(
    "results.ratings.judging.you_ran_scored_trial_someone",
    "you ran or scored trial {code}: someone else rates it again",
)
_YOU_HAVE_SEEN_RESULTS_SECOND = Pattern(
    "results.ratings.judging.you_have_seen_results_second",
    "you have seen results of {plan}: a second rater must not know them",
)
_OUTCOME_ALLOWED = Pattern(
    "results.ratings.judging.outcome_allowed",
    "outcome = {outcome!r:.80}; allowed: {values}",
)
_WHY_EMPTY_SAY_SENTENCE_OTHERS = fixed(
    "results.ratings.judging.why_empty_say_sentence_others",
    "why is empty: say it in a sentence, others read it",
)
_WERE_NOT_RUN_ONE_AFTER = Pattern(
    "results.ratings.judging.were_not_run_one_after",
    "{first} and {second} were not run one after the other at the same initial condition",
)
_YOU_HAVE_SEEN_RESULTS_RATER = Pattern(
    "results.ratings.judging.you_have_seen_results_rater",
    "you have seen results of {plan}: a rater of preferences must not know them",
)
_HAS_NO_TRIAL = Pattern("results.ratings.judging.has_no_trial", "{plan} has no trial {code!r:.20}")
_OTHERWISE_WHAT_SAID_STANDS = Pattern(
    "results.ratings.judging.otherwise_what_said_stands",
    "{twice}, with another answer: the first one counts",
)

_STATES = (PlanState.FROZEN, PlanState.CLOSED, PlanState.REVEALED)


T = TypeVar("T")
_NAMED = 200  # pairs per database query


class NextItem(NamedTuple, Generic[T]):
    """Next item for one rater (`found`, None if there is none), and the number of items for this rater (`left`).

    `passed` are codes of earlier trials that were skipped, because this machine has no images of them.
    """

    found: T | None
    left: int
    passed: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Pair:
    """Two trials that were run consecutively from the same initial condition, in that order."""

    plan: Plan
    first: Handout
    second: Handout


def rating_sample(plan: Plan) -> list[int]:
    """Return the schedule positions of the trials to be rated again, in a random order drawn by the plan's key."""
    n = plan.slots.count()
    drawn = SeededDraws(bytes(plan.key or b""), "second rater").shuffled(range(n))
    return drawn[: math.ceil(plan.second_rater_share * n)]


def next_to_rate(user: User) -> NextItem[Handout]:
    """Return the next trial with images that this user may rate again."""
    mine: list[Handout] = []
    for plan in Plan.objects.filter(state__in=_STATES, second_rater_share__gt=0).order_by("pk"):
        if has_looked_at_the_same(plan, user):
            continue
        open_ones = {handout.slot.index: handout for handout in _unrated(plan, user)}
        mine += [open_ones[index] for index in rating_sample(plan) if index in open_ones]
    return _offered(mine, len(mine), lambda handout: (handout,))


def _rated_first(change: str, trial: Trial, user: User) -> None:
    """Refuse to let a potential second rater of the trial correct the wording of its score.

    The correction would disqualify the user as a second rater, mostly of failures, and a second rater must not know the
    score's wording.

    Raises:
        NotAllowed: If `change` is "reworded" and the user may still be asked to rate the trial.
    """
    if change != "reworded":
        return
    if any(_still_rates(user, plan, trial) for plan in Plan.objects.filter(handouts__trial=trial)):
        raise NotAllowed(_TRIAL_RATED_BY_SECOND_PERSON(trial=trial.pk))


register_check(_rated_first)


@still_judges
def _can_rate(user: User, episode: Episode) -> bool:
    """Return True if this user may be asked to rate the trial of an episode a second time."""
    trial = getattr(episode, "trial", None)
    if trial is None or role_of(user) is Role.VIEWER:
        return False
    return any(_still_rates(user, plan, trial) for plan in Plan.objects.filter(handouts__trial=trial))


def _still_rates(user: User, plan: Plan, trial: Trial) -> bool:
    if plan.state not in _STATES or not plan.second_rater_share:
        return False
    handout = _unrated(plan, user).filter(trial=trial).first()
    if handout is None or not handout.trial.episode.cameras or has_looked_at_the_same(plan, user):
        return False  # this user will not be asked
    return handout.slot.index in rating_sample(plan)


def _offered(waiting: Iterable[T], count: int, of: Callable[[T], tuple[Handout, ...]]) -> NextItem[T]:
    """Return the next item to rate: the first with all images, else the first whose images may still arrive.

    The result also names, as `passed`, the codes of the trials without images that were skipped on the way. `waiting`
    is read no further than necessary.

    Args:
        waiting: Items that wait for a rating, in order.
        count: Number of waiting items, which becomes `left` of the result.
        of: Function that returns the handouts of an item's trials.
    """
    for is_present, items in zip((is_watchable, may_become_watchable), tee(waiting), strict=True):
        passed: list[str] = []
        for item in items:
            lacking = [handout.code for handout in of(item) if not is_present(handout.trial.episode)]
            if not lacking:
                return NextItem(item, count, tuple(dict.fromkeys(passed)))
            passed += lacking
    return NextItem(None, count, tuple(dict.fromkeys(passed)))


def _unrated(plan: Plan, user: User) -> QuerySet[Handout]:
    rated = Rating.objects.filter(trial=OuterRef("trial"))
    scored_by_me = Score.objects.filter(trial=OuterRef("trial"), rater=user)
    rows = plan.handouts.filter(trial__status=TrialStatus.SCORED, trial__episode__isnull=False)
    rows = rows.exclude(trial__episode__status=EpisodeStatus.MISSING)  # it would stay in the queue for ever
    rows = rows.exclude(trial__operator=user).exclude(Exists(rated)).exclude(Exists(scored_by_me))
    return rows.select_related("slot", "plan", "trial__scene", "trial__episode")


@transaction.atomic
def save_rating(
    *,
    user: User,
    plan: Plan,
    code: str,
    milestones: Mapping[object, object],
    success: bool | None = None,
    failure: str = "",
    failure_phase: str = "",
    note: str = "",
) -> Rating:
    """Record a second rating of the trial with that code: in the journal, then in the database.

    Raises:
        Conflict: If the trial is not to be rated again, has no video, or the user has rated it differently before.
        NotAllowed: If the user ran or scored the trial, or has seen results of the plan.
    """
    require_role(user, Role.OPERATOR)
    handout = _handout(plan, code)
    trial = handout.trial
    if handout.slot.index not in rating_sample(plan) or trial.status != TrialStatus.SCORED:
        raise Conflict(_TRIAL_NOT_ONE_THOSE_RATED(code=code, plan=plan))
    if trial.operator_id == user.pk or trial.scores.filter(rater=user).exists():
        raise NotAllowed(_YOU_RAN_SCORED_TRIAL_SOMEONE(code=code))
    run_checks("judged", trial, user)
    repeat_text = f"you have rated trial {code} already"
    fails = bool(failing(trial))
    outcome = score_outcome(list(trial.scene.milestones.order_by("order")), milestones, success, fails=fails)
    values = {
        "success": outcome.success,
        "score": outcome.score,
        "milestones": [[row[0].text, row[1]] for row in outcome.reached],
        **failures.clean_failure(failure_phase=failure_phase, failure=failure),
        "note": clean_text("note", note, LONGEST_NOTE),
    }
    before = Rating.objects.filter(trial=trial, rater=user).first()
    if before is not None:
        return _is_repeat(before, values, repeat_text)
    if has_looked_at_the_same(plan, user):
        raise NotAllowed(_YOU_HAVE_SEEN_RESULTS_SECOND(plan=plan))
    failures.check_failure(trial.scene, values, success=outcome.success)
    require_video(handout)
    rating = Rating(trial=trial, rater=user, blind=plan.sealed, **values)
    RATINGS.append(journal_uuid(trial), RatingLine.written(rating))
    return _once(rating, repeat_text)


def next_to_compare(user: User, plans: Iterable[Plan] | None = None) -> NextItem[Pair]:
    """Return the next pair of trials that this user has not compared yet and whose images are on this machine.

    If there is no such pair, the next pair whose images may still arrive is returned.
    """
    fresh: list[tuple[Plan, list[tuple[int, int]]]] = []
    for plan in plans if plans is not None else Plan.objects.filter(state__in=_STATES).order_by("pk"):
        if not has_looked_at_the_same(plan, user):
            judged = set(Preference.objects.filter(plan=plan, rater=user).values_list("first", "second"))
            fresh.append((plan, [pair for pair in _pairs(plan) if pair not in judged]))
    named = (
        pair
        for plan, pairs in fresh
        for begin in range(0, len(pairs), _NAMED)
        for pair in _named(plan, pairs[begin : begin + _NAMED])
    )
    return _offered(named, sum(len(pairs) for _, pairs in fresh), lambda pair: (pair.first, pair.second))


def _pairs(plan: Plan) -> list[tuple[int, int]]:
    """Return the pairs of consecutive trials in one block that both count and are recorded on this disk."""
    rows = plan.handouts.filter(trial__status=TrialStatus.SCORED, trial__episode__isnull=False)
    blocks: dict[int, list[tuple[int, str]]] = defaultdict(list)
    of_each = rows.order_by("number").values_list("slot__block", "trial", "trial__episode__status")
    for block, trial, status in of_each:
        blocks[block].append((trial, status))
    gone = EpisodeStatus.MISSING
    neighbours = (pair for block in blocks.values() for pair in pairwise(block))
    return [
        (first, second)
        for (first, at), (second, second_status) in neighbours
        if gone not in (at, second_status)
    ]


def _named(plan: Plan, pairs: Sequence[tuple[int, int]]) -> list[Pair]:
    trials = {trial for pair in pairs for trial in pair}
    of_plan = plan.handouts.filter(trial__in=trials)
    rows = {
        row.trial_id: row
        for row in of_plan.select_related("trial__episode", "trial__scene", "trial__position")
    }
    return [Pair(plan, rows[first], rows[second]) for first, second in pairs]


@transaction.atomic
def save_preference(*, user: User, plan: Plan, first: str, second: str, outcome: str, why: str) -> Preference:
    """Record which of two trials was better, in the journal, then in the database; `first` was run first.

    Raises:
        Conflict: If they were not run consecutively, lack a video, or the user has compared them differently
            before.
        NotAllowed: If the user has seen results of the plan.
    """
    require_role(user, Role.OPERATOR)
    if outcome not in Preference.Outcome.values:
        raise EvaError(_OUTCOME_ALLOWED(outcome=outcome, values=", ".join(Preference.Outcome.values)))
    reason = clean_text("why", why, LONGEST_NOTE)
    if not reason:
        raise EvaError(_WHY_EMPTY_SAY_SENTENCE_OTHERS)
    first_handout, second_handout = _handout(plan, first), _handout(plan, second)
    if (first_handout.trial_id, second_handout.trial_id) not in _pairs(plan):
        raise Conflict(_WERE_NOT_RUN_ONE_AFTER(first=first, second=second))
    repeat_text = f"you have compared {first} and {second} already"
    values = {"outcome": outcome, "why": reason}
    before = Preference.objects.filter(
        first=first_handout.trial, second=second_handout.trial, rater=user
    ).first()
    if before is not None:
        return _is_repeat(before, values, repeat_text)
    if has_looked_at_the_same(plan, user):
        raise NotAllowed(_YOU_HAVE_SEEN_RESULTS_RATER(plan=plan))
    require_video(first_handout, second_handout)
    row = Preference(
        plan=plan,
        first=first_handout.trial,
        second=second_handout.trial,
        rater=user,
        blind=plan.sealed,
        **values,
    )
    RATINGS.append(journal_uuid(second_handout.trial), PreferenceLine.written(row))
    return _once(row, repeat_text)


def _handout(plan: Plan, code: str) -> Handout:
    """Return the handout of a code with its trial's row locked for the transaction, so that only one process
    writes its journal.
    """
    rows = plan.handouts.select_related("slot", "trial__scene", "trial__episode")
    handout = rows.filter(code=code).first()
    if handout is None:
        raise NotFound(_HAS_NO_TRIAL(plan=plan, code=code))
    handout.trial.status = Trial.objects.select_for_update().get(pk=handout.trial_id).status
    return handout


def _is_repeat(before: T, values: Mapping[str, Any], repeat_text: str) -> T:
    """Return the earlier answer `before`, because the same answer was sent again, as after a lost reply.

    Raises:
        Conflict: If the new answer differs.
    """
    if any(getattr(before, name) != value for name, value in values.items()):
        raise Conflict(_OTHERWISE_WHAT_SAID_STANDS(twice=repeat_text))
    return before


def _once(row: Any, repeat_text: str) -> Any:
    try:
        with transaction.atomic():
            row.save()
    except IntegrityError:
        raise Conflict(repeat_text) from None
    return row
