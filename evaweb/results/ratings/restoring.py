"""Second ratings and preferences that the database has lost, made again from the files of scores; see .journal."""

from __future__ import annotations

import logging

from django.db import transaction

from evaweb.episodes.reconcile import Kept, restores
from evaweb.errors import EvaError
from evaweb.plans.models import Plan
from evaweb.results.models import Preference, Rating
from evaweb.results.ratings.journal import KeptPreference, KeptRating, kept_judgement
from evaweb.roles import known_person
from evaweb.trials.kept import KeptTrial
from evaweb.trials.models import Trial

log = logging.getLogger(__name__)


@restores
def restore(kept: Kept) -> int:
    """Make the rows that are not there; how many that were. The trials themselves were restored before."""
    made = 0
    for number, line in enumerate(kept.lines, start=1):
        found = kept_judgement(line, number)
        if isinstance(found, KeptRating):
            made += _rating(found)
        elif isinstance(found, KeptPreference):
            made += _preference(found)
    return made


@transaction.atomic
def _rating(line: KeptRating) -> bool:
    if Rating.objects.filter(uuid=line.uuid).exists():
        return False
    trial, rater = _trial(line.trial), known_person(line.rater)
    if Rating.objects.filter(trial=trial, rater=rater).exists():
        return False  # written twice: the database took one of them
    Rating.objects.create(
        trial=trial,
        rater=rater,
        milestones=[list(row) for row in line.milestones],
        **line.model_dump(include={"uuid", "at", "success", "score", "failure", "note", "blind"}),
    )
    return True


@transaction.atomic
def _preference(line: KeptPreference) -> bool:
    if Preference.objects.filter(uuid=line.uuid).exists():
        return False
    first, second, rater = _trial(line.first), _trial(line.second), known_person(line.rater)
    if Preference.objects.filter(first=first, second=second, rater=rater).exists():
        return False
    plan = Plan.objects.filter(name=line.plan, version=line.version).first()
    if plan is None:
        log.warning("preference %s is of plan %s v%d, which is lost", line.uuid, line.plan, line.version)
    Preference.objects.create(
        plan=plan,
        first=first,
        second=second,
        rater=rater,
        **line.model_dump(include={"uuid", "at", "outcome", "why", "blind"}),
    )
    return True


def _trial(facts: KeptTrial) -> Trial:
    found = Trial.objects.filter(uuid=facts.uuid).first()
    if found is None:
        raise EvaError(
            f"a judgement is of trial {facts.uuid}, which is neither in the database nor on this disk"
        )
    return found
