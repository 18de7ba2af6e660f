"""The database refuses what our services never do."""

import pytest
from django.db import IntegrityError, transaction

from evaweb.trials import services
from evaweb.trials.models import MilestoneOutcome, Score, Trial
from tests.evaweb.trials import builders


@pytest.fixture
def scored(db):
    bench = builders.bench()
    return bench, bench.scored()


def refused(change):
    with pytest.raises(IntegrityError, match="never"), transaction.atomic():
        change()


def test_a_score_is_neither_changed_nor_removed(scored):
    _, trial = scored
    refused(lambda: Score.objects.filter(trial=trial).update(success=False))
    refused(lambda: MilestoneOutcome.objects.filter(score__trial=trial).update(reached=False))
    refused(lambda: MilestoneOutcome.objects.filter(score__trial=trial).delete())
    assert Score.objects.get(trial=trial).success
    Trial.objects.filter(pk=trial.pk).update(verdict=None)
    refused(lambda: Score.objects.filter(trial=trial)._raw_delete("default"))


def test_a_scored_trial_stays_what_was_tried(scored):
    bench, trial = scored
    refused(lambda: Trial.objects.filter(pk=trial.pk).update(number=7))
    refused(lambda: Trial.objects.filter(pk=trial.pk).update(operator=builders.user("eve")))
    Trial.objects.filter(pk=trial.pk).update(reason="what may change does")
    prepared = bench.prepare()
    Trial.objects.filter(pk=prepared.pk).update(number=7)


def test_corrections_and_voids_go_on(scored):
    bench, trial = scored
    services.trial_score(
        user=bench.operator, trial=trial, milestones=bench.ticks(True, False, False), reason="seen again"
    )
    assert Score.objects.filter(trial=trial).count() == 2
    services.trial_void(user=bench.operator, trial=trial, reason="the camera had moved")
    assert trial.status == "voided"


def test_a_milestone_can_still_be_removed_from_its_scene(scored):
    bench, trial = scored
    bench.scene.milestones.first().delete()
    assert MilestoneOutcome.objects.filter(score__trial=trial, milestone=None).count() == 1
