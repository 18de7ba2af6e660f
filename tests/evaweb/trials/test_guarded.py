"""The database refuses what our services never do."""

import pytest
from django.core.management import call_command
from django.db import IntegrityError, connection, transaction
from django.utils import timezone

from evaweb.episodes.models import Episode
from evaweb.trials import lifecycle, services, voids
from evaweb.trials.models import FailureTerm, MilestoneOutcome, Score, Trial, TrialStatus
from tests.evaweb.trials import builders


@pytest.fixture
def scored(db):
    bench = builders.bench()
    return bench, bench.scored()


def sql(statement):
    with connection.cursor() as cursor:
        cursor.execute(statement)


def correct(bench, trial):
    ticks = bench.ticks(True, False, False)
    reason = f"seen again, {Score.objects.count()}"
    services.score_trial(user=bench.operator, trial=trial, milestones=ticks, reason=reason)


def refused(change):
    with pytest.raises(IntegrityError, match="never"), transaction.atomic():
        change()


def test_a_score_is_neither_changed_nor_removed(scored):
    _, trial = scored
    refused(lambda: Score.objects.filter(trial=trial).update(success=False))
    refused(lambda: MilestoneOutcome.objects.filter(score__trial=trial).update(reached=False))
    refused(lambda: MilestoneOutcome.objects.filter(score__trial=trial).delete())
    refused(lambda: Score.objects.filter(trial=trial)._raw_delete("default"))
    refused(lambda: sql("UPDATE trials_score SET id = id + 900"))
    assert Score.objects.get(trial=trial).success


@pytest.mark.django_db(transaction=True)
def test_a_database_with_guarded_scores_is_brought_up_to_date_and_guarded_again():
    score = builders.bench().scored(success=False).verdict
    call_command("migrate", "trials", "0006_void_requests", verbosity=0)
    call_command("migrate", verbosity=0)
    found = Score.objects.get()
    assert (found, found.success, found.failure_phase) == (score, False, "")
    assert FailureTerm.objects.filter(active=True).count() == 13
    refused(lambda: Score.objects.update(failure_phase="grasp"))
    refused(lambda: Trial.objects.update(operator=builders.user("eve")))


def test_a_score_is_not_replaced_either(scored):
    columns = ", ".join(field.column for field in Score._meta.concrete_fields)
    refused(lambda: sql(f"REPLACE INTO trials_score ({columns}) SELECT {columns} FROM trials_score"))


def test_a_score_gets_no_further_milestone_once_it_counts_or_was_corrected(scored):
    bench, trial = scored
    for _ in range(2):
        for score in Score.objects.filter(trial=trial):
            more = MilestoneOutcome(score=score, order=77, text="x", points=1, required=True, reached=True)
            refused(more.save)
        correct(bench, trial)


def test_a_verdict_is_a_score_of_the_trial_and_gives_way_to_a_later_one_alone(scored):
    bench, trial = scored
    other, first = bench.scored(success=False), trial.verdict
    correct(bench, trial)
    for verdict in (first, other.verdict, None):
        refused(lambda to=verdict: Trial.objects.filter(pk=trial.pk).update(verdict=to))
    ended = bench.ended()
    refused(lambda: Trial.objects.filter(pk=ended.pk).update(verdict=other.verdict))


@pytest.mark.parametrize("status", ["scored", "voided"])
def test_a_judged_trial_goes_no_other_way(scored, status):
    bench, trial = scored
    if status == "voided":
        voids.void_trial(user=bench.operator, trial=trial, reason="the camera had moved")
    row, way = Trial.objects.filter(pk=trial.pk), Trial.append_only.allowed_changes["status"][status]
    for other in TrialStatus:
        if other not in (status, *way):
            refused(lambda to=other: row.update(status=to))
    foreseen = {after for (before, _), after in lifecycle.TRANSITIONS.items() if before == status}
    assert foreseen - {status} == set(way)
    changes = {"number": 50, "duration_s": 1.0, "time_limit_s": 3.0, "started_at": timezone.now(), "id": 99}
    for name, value in changes.items():
        refused(lambda change={name: value}: row.update(**change))


def test_why_a_trial_was_voided_stays(scored):
    bench, trial = scored
    voids.void_trial(user=bench.operator, trial=trial, reason="the camera had moved")
    refused(lambda: Trial.objects.filter(pk=trial.pk).update(reason="it was too slow"))
    refused(lambda: Trial.objects.filter(pk=trial.pk).update(voided_by=builders.user("eve")))


def test_what_comes_after_the_score_is_told_once(scored):
    _, trial = scored
    row = Trial.objects.filter(pk=trial.pk)
    row.update(truth={"placed": True})
    refused(lambda: row.update(truth={"placed": False}))
    episode = Episode.objects.create(station=trial.station, status="finished", duration_s=4.5)
    if trial.episode is None:
        row.update(episode=episode)
    Episode.objects.filter(pk=row.get().episode_id).update(duration_s=4.5)
    row.update(duration_s=4.5)
    refused(lambda: row.update(episode=None))


def test_a_scored_trial_stays_what_was_tried(scored):
    bench, trial = scored
    refused(lambda: Trial.objects.filter(pk=trial.pk).update(number=7))
    refused(lambda: Trial.objects.filter(pk=trial.pk).update(operator=builders.user("eve")))
    Trial.objects.filter(pk=trial.pk).update(reason="what may change does")
    prepared = bench.prepare()
    Trial.objects.filter(pk=prepared.pk).update(number=7)


def test_corrections_and_voids_go_on(scored):
    bench, trial = scored
    correct(bench, trial)
    assert Score.objects.filter(trial=trial).count() == 2
    voids.void_trial(user=bench.operator, trial=trial, reason="the camera had moved")
    assert trial.status == "voided"


def test_a_milestone_can_still_be_removed_from_its_scene(scored):
    bench, trial = scored
    bench.scene.milestones.first().delete()
    assert MilestoneOutcome.objects.filter(score__trial=trial, milestone=None).count() == 1
