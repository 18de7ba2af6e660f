"""Restoring of ratings, preferences and judgements that the database has lost.

They are read from the journals of scores, whose lines are declared in the module `record`.
"""

from __future__ import annotations

import logging

from django.db import DataError, IntegrityError, transaction

from evaweb.core.errors import EvaError
from evaweb.episodes.reconcile import RestorableRun, register_restorer
from evaweb.plans.models import Plan
from evaweb.results.models import Judgement, Preference, Rating
from evaweb.results.ratings.record import JudgementLine, PreferenceLine, RatingLine
from evaweb.trials.models import Trial
from evaweb.trials.record import TrialRecord
from runtime.core.sentences import Pattern

log = logging.getLogger(__name__)
_JUDGEMENT_TRIAL_WHICH_NEITHER_DATABASE = Pattern(
    "results.ratings.restoring.judgement_trial_which_neither_database",
    "a judgement is of trial {uuid}, which is neither in the database nor on this disk",
)


@register_restorer
def restore(kept: RestorableRun) -> int:
    """Create the missing rows of ratings, preferences and judgements from the lines of a run; return their number.

    The trials must have been restored before.
    """
    count = 0
    for line in kept.lines:
        try:
            if isinstance(line, RatingLine):
                count += _rating(line)
            elif isinstance(line, PreferenceLine):
                count += _preference(line)
            elif isinstance(line, JudgementLine):
                count += _judgement(line)
        except (EvaError, DataError, IntegrityError) as error:
            kept.report_problem(f"run {kept.uuid}: its {line.kind} {line.uuid}: {error}")
    return count


@transaction.atomic
def _rating(line: RatingLine) -> bool:
    if Rating.objects.filter(uuid=line.uuid).exists():
        return False
    trial, values = _trial(line.trial), line.to_row_values()
    if Rating.objects.filter(trial=trial, rater=values["rater"]).exists():
        return False  # written twice, of which the database accepted one
    Rating.objects.create(trial=trial, **values)
    return True


@transaction.atomic
def _preference(line: PreferenceLine) -> bool:
    if Preference.objects.filter(uuid=line.uuid).exists():
        return False
    first, second, values = _trial(line.first), _trial(line.second), line.to_row_values()
    if Preference.objects.filter(first=first, second=second, rater=values["rater"]).exists():
        return False
    plan = Plan.objects.filter(name=line.plan, version=line.version).first()
    if plan is None:
        log.warning("preference %s is of plan %s v%d, which is lost", line.uuid, line.plan, line.version)
    Preference.objects.create(plan=plan, first=first, second=second, **values)
    return True


@transaction.atomic
def _judgement(line: JudgementLine) -> bool:
    if Judgement.objects.filter(uuid=line.uuid).exists():
        return False
    trial, values = _trial(line.trial), line.to_row_values()
    if Judgement.objects.filter(trial=trial, judge=line.judge, version=line.version).exists():
        return False
    Judgement.objects.create(trial=trial, **values)
    return True


def _trial(facts: TrialRecord) -> Trial:
    trial = Trial.objects.filter(uuid=facts.uuid).first()
    if trial is None:
        raise EvaError(_JUDGEMENT_TRIAL_WHICH_NEITHER_DATABASE(uuid=facts.uuid))
    return trial
