import pytest

from evaweb.episodes.models import Episode
from evaweb.errors import Conflict, EvaError, NotAllowed
from evaweb.plans.models import Plan
from evaweb.plans.services import plan_freeze
from evaweb.plans.sight import look
from evaweb.results import judging
from evaweb.results.agreement import agreement_of, preferences_of
from evaweb.results.models import Preference, Rating
from evaweb.trials.models import Checkpoint
from tests.evaweb.trials import builders


@pytest.fixture
def rater(db):
    return builders.user("rita")


def test_half_of_the_trials_are_rated_again_by_somebody_else(plan, carry_out, rater, bench):
    carry_out(plan, 16)
    assert len(judging.sample_of(plan)) == 8
    assert judging.to_rate(bench.operator) == (None, 0)  # ran them all
    seen = []
    for left in range(8, 0, -1):
        handout, there = judging.to_rate(rater)
        assert there == left
        seen.append(handout.slot.index)
        judging.rate(user=rater, plan=plan, code=handout.code, milestones=bench.ticks(True, True, True))
    assert seen == judging.sample_of(plan)
    assert judging.to_rate(rater) == (None, 0)
    found = agreement_of(plan)
    assert (found["trials"], found["blind"], found["success"]["n"]) == (8, 8, 8)


def test_a_second_rating_changes_no_score(plan, carry_out, rater, bench):
    carry_out(plan, 16)
    handout, _ = judging.to_rate(rater)
    before = handout.trial.verdict_id
    judging.rate(user=rater, plan=plan, code=handout.code, milestones=bench.ticks(False, False, False))
    handout.trial.refresh_from_db()
    assert handout.trial.verdict_id == before
    with pytest.raises(Conflict, match="already"):
        judging.rate(user=rater, plan=plan, code=handout.code, milestones=bench.ticks(True, True, True))


def test_who_must_not_rate_is_told_why(plan, owner, carry_out, bench, rater):
    carry_out(plan, 16)
    handout, _ = judging.to_rate(rater)
    ticks = bench.ticks(True, True, True)
    with pytest.raises(NotAllowed, match="you ran or scored"):
        judging.rate(user=bench.operator, plan=plan, code=handout.code, milestones=ticks)
    look(plan, owner)
    assert judging.to_rate(owner) == (None, 0)
    with pytest.raises(NotAllowed, match="must not know"):
        judging.rate(user=owner, plan=plan, code=handout.code, milestones=ticks)
    with pytest.raises(NotAllowed):
        judging.rate(user=builders.user("vera", "viewer"), plan=plan, code=handout.code, milestones=ticks)
    other = plan.handouts.exclude(slot__index__in=judging.sample_of(plan)).first()
    with pytest.raises(Conflict, match="not one of those"):
        judging.rate(user=rater, plan=plan, code=other.code, milestones=ticks)


def test_two_trials_in_a_row_are_preferred_one_over_the_other(plan, carry_out, rater):
    carry_out(plan, 16)
    pair, left = judging.to_prefer(rater)
    assert left == 8
    assert pair.first.slot.block == pair.second.slot.block
    assert pair.first.number < pair.second.number
    codes = {"first": pair.first.code, "second": pair.second.code}
    with pytest.raises(EvaError, match="why is empty"):
        judging.prefer(user=rater, plan=plan, outcome="first", why=" ", **codes)
    with pytest.raises(EvaError, match="allowed: first, second, tie"):
        judging.prefer(user=rater, plan=plan, outcome="left", why="x", **codes)
    judging.prefer(user=rater, plan=plan, outcome="first", why="it let go gently", **codes)
    with pytest.raises(Conflict, match="already"):
        judging.prefer(user=rater, plan=plan, outcome="tie", why="x", **codes)
    with pytest.raises(Conflict, match="one after the other"):
        judging.prefer(
            user=rater, plan=plan, outcome="tie", why="x", first=codes["second"], second=codes["first"]
        )
    assert judging.to_prefer(rater)[1] == 7
    found = preferences_of(plan)
    assert (found["n"], found["ranking"]) == (1, None)
    assert found["reason"]


def test_the_database_keeps_what_was_said(plan, carry_out, rater, bench):
    carry_out(plan, 16)
    handout, _ = judging.to_rate(rater)
    rating = judging.rate(user=rater, plan=plan, code=handout.code, milestones=bench.ticks(True, True, True))
    with pytest.raises(Exception, match="never changed"):
        Rating.objects.filter(pk=rating.pk).update(success=False)


def test_and_what_was_preferred(plan, carry_out, rater):
    carry_out(plan, 4)
    pair, _ = judging.to_prefer(rater)
    made = judging.prefer(
        user=rater, plan=plan, outcome="tie", why="alike", first=pair.first.code, second=pair.second.code
    )
    with pytest.raises(Exception, match="never changed or removed"):
        Preference.objects.filter(pk=made.pk).delete()


def test_nobody_is_asked_about_what_cannot_be_watched(plan, carry_out, rater):
    carry_out(plan, 16)
    handout, left = judging.to_rate(rater)
    pair, pairs = judging.to_prefer(rater)
    lost = {handout.trial.episode_id, pair.first.trial.episode_id}
    Episode.objects.filter(pk__in=lost).update(status="missing")
    again, fewer = judging.to_rate(rater)
    other, fewer_pairs = judging.to_prefer(rater)
    assert fewer < left
    assert fewer_pairs < pairs
    assert again.trial.episode_id not in lost
    assert not lost & {other.first.trial.episode_id, other.second.trial.episode_id}


def test_what_was_not_run_one_after_the_other_is_no_pair_because_one_between_is_gone(
    plan, carry_out, rater, bench, owner
):
    third = Checkpoint.objects.create(name="pi0-third", policy={})
    wide = Plan.objects.create(name="three", title="Three", owner=owner, repetitions=1)
    wide.checkpoints.set([*plan.checkpoints.all(), third])
    wide.positions.set(bench.scene.positions.all())
    carry_out(plan_freeze(user=owner, plan=wide), 3)
    before, after = judging._pairs(wide)
    assert before[1] == after[0]
    Episode.objects.filter(trial=before[1]).update(status="missing")
    assert judging._pairs(wide) == []
    assert judging.to_prefer(rater) == (None, 0)
