import pytest
from django.utils import timezone

from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.blinding_rules import record_unblinding
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.stations.models import Lease
from evaweb.trials import corrections, services, voids
from evaweb.trials.models import Milestone
from evaweb.trials.record import JUDGEMENTS, journal_uuid
from tests.evaweb.trials import builders

SAID = {"failure_phase": "grasp", "failure": "dropped"}


@pytest.fixture
def terms(db):
    return builders.failure_terms()


def score(bench, trial, **given):
    ticks = bench.ticks(True, False, False)
    return services.score_trial(**{"user": bench.operator, "trial": trial, "milestones": ticks, **given})


def corrected(bench, trial, **given):
    return corrections.trial_failure(**{"user": bench.operator, "trial": trial, **given})


def test_a_corrected_failure_is_another_score_that_leaves_all_else_as_it_was(bench, terms):
    trial = bench.ended()
    first, _, _ = bench.ticks(True, False, False)
    before = score(bench, trial, note="slid <off>", times={first: 2.5}, **SAID)
    after = corrected(bench, trial, failure="missed", score=before.uuid)
    assert (after.failure_phase, after.failure, after.note) == ("grasp", "missed", "slid <off>")
    assert after.reason == "failure was grasp: dropped, now grasp: missed"
    said = [list(row.outcomes.values_list("order", "reached", "at_s")) for row in (before, after)]
    assert said[0] == said[1] == [(1, True, 2.5), (2, False, None), (3, False, None)]
    assert [row.pk for row in trial.scores.all()] == [before.pk, after.pk]
    undone = corrected(bench, trial, **SAID, reason="undone")
    assert (undone.why, undone.reason) == ("grasp: dropped", "undone")
    assert corrected(bench, trial, **SAID) == undone  # asked for once more
    assert (
        corrected(bench, trial, failure_phase="", failure="").reason
        == "failure was grasp: dropped, now not specified"
    )


def test_a_failure_that_another_user_corrected_meanwhile_is_not_overwritten(bench, terms):
    trial = bench.ended()
    seen = score(bench, trial, **SAID)
    corrected(bench, trial, failure="missed", score=seen.uuid)
    with pytest.raises(Conflict, match=r"scored anew by ann meanwhile \(grasp: missed\)"):
        corrected(bench, trial, failure_phase="approach", score=seen.uuid)
    assert trial.scores.count() == 2


def test_only_a_failure_that_counts_is_corrected_by_operators_in_the_labs_words(bench, terms):
    trial = bench.scored(False)
    refused = [
        (bench.scored(True), EvaError, "the trial is a success"),
        (
            voids.void_trial(user=bench.operator, trial=bench.scored(False), reason="a hand"),
            Conflict,
            "is voided",
        ),
        (bench.ended(), Conflict, "is to be scored: only a score that counts has a failure"),
    ]
    for other, error, message in refused:
        with pytest.raises(error, match=message):
            corrected(bench, other, failure="dropped")
    with pytest.raises(EvaError, match="failure_phase = 'grip'; allowed: approach, grasp"):
        corrected(bench, trial, failure_phase="grip")
    with pytest.raises(NotAllowed, match="is a viewer"):
        corrected(bench, trial, user=builders.user("eve", "viewer"), failure="dropped")
    assert trial.scores.count() == 1


def test_who_has_looked_behind_a_blind_corrects_no_failure_of_it(bench, terms):
    owner = builders.user("olga")
    plan = Plan.objects.create(name="blocks", title="Blocks", owner=owner, repetitions=1)
    plan.checkpoints.set([bench.checkpoint])
    plan.positions.set(bench.scene.positions.all())
    plan = freeze_plan(user=owner, plan=plan)
    trial = builders.finished_trial(
        allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    )
    score(bench, trial, **SAID)
    record_unblinding(plan, owner)
    with pytest.raises(NotAllowed, match="you have seen results of Blocks"):
        corrected(bench, trial, user=owner, failure="missed")
    assert corrected(bench, trial, failure="missed").why == "grasp: missed"


def test_a_scene_that_changed_since_changes_no_score_whose_failure_is_corrected(bench, terms):
    trial = bench.ended()
    before = score(bench, trial, **SAID)
    milestone = bench.scene.milestones.order_by("order").first()
    milestone.points, milestone.text = 50, "held tight"
    milestone.save()
    Milestone.objects.create(scene=bench.scene, order=9, text="let go", required=True)
    after = corrected(bench, trial, failure="missed")
    assert (after.success, after.score, after.why) == (before.success, before.score, "grasp: missed")
    fields = ("milestone", "order", "text", "points", "required", "reached", "at_s")
    said = [list(row.outcomes.values_list(*fields)) for row in (before, after)]
    assert said[0] == said[1]
    trial.refresh_from_db()
    assert trial.verdict == after
    *_, line = JUDGEMENTS.read(journal_uuid(trial), pytest.fail)
    assert (line.uuid, line.score) == (after.uuid, before.score)
    assert [outcome.points for outcome in line.milestones] == [row.points for row in before.outcomes.all()]


@pytest.mark.parametrize("what", ["score", "abandon"])
def test_what_another_has_done_is_undone_by_who_has_the_station_now_and_administrators(bench, terms, what):
    trial = bench.prepare() if what == "abandon" else bench.ended()
    if what != "abandon":
        score(bench, trial, **SAID)
    undo = {
        "score": lambda who: score(
            bench, trial, user=who, reason=f"{who} saw it", milestones=bench.ticks(True, True, False)
        ),
        "abandon": lambda who: services.abandon_trial(user=who, trial=trial),
    }[what]
    bob, alma = builders.user("bob"), builders.user("alma", "admin")
    lease = Lease.objects.create(station=bench.station, user=bench.operator, holder="web:ann:p1", epoch=1)
    for changed in ({}, {"user": bob, "ended_at": timezone.now()}):
        Lease.objects.filter(pk=lease.pk).update(**changed)
        with pytest.raises(
            NotAllowed, match=rf"trial {trial.pk} is ann's, and bob does not have bench-1; allowed: ann"
        ):
            undo(bob)
    Lease.objects.filter(pk=lease.pk).update(ended_at=None)
    undo(bob)
    trial.refresh_from_db()
    assert "bob" in (trial.reason if what == "abandon" else trial.verdict.rater.get_username())
    if what == "score":
        assert undo(alma).rater == alma
        assert corrected(bench, bench.scored(False), user=bob, failure="missed").rater == bob, (
            "words are anybody's"
        )
