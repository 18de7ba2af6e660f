from datetime import timedelta

import pytest

from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.episodes.folders import journal_folder, preview_folder
from evaweb.episodes.models import Episode
from evaweb.plans.blinding_rules import record_unblinding
from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.records import journal as lines
from evaweb.results.analysis.agreement import judge_agreement, preference_ranking, rater_agreement
from evaweb.results.models import Judgement, Preference, Rating
from evaweb.results.ratings import rating_queue
from evaweb.trials import services
from evaweb.trials.corrections import trial_failure
from evaweb.trials.models import Checkpoint, Milestone
from tests.evaweb.trials import builders
from tests.evaweb.unguarded import without_triggers


@pytest.fixture
def rater(db):
    return builders.user("rita")


def test_half_of_the_trials_are_rated_again_by_somebody_else(plan, carry_out, rater, bench):
    carry_out(plan, 16)
    assert len(rating_queue.rating_sample(plan)) == 8
    assert rating_queue.next_to_rate(bench.operator)[:2] == (None, 0)  # ran them all
    seen = []
    for left in range(8, 0, -1):
        handout, there = rating_queue.next_to_rate(rater)[:2]
        assert there == left
        seen.append(handout.slot.index)
        rating_queue.save_rating(
            user=rater, plan=plan, code=handout.code, milestones=bench.ticks(True, True, True)
        )
    assert seen == rating_queue.rating_sample(plan)
    assert rating_queue.next_to_rate(rater)[:2] == (None, 0)
    found = rater_agreement(plan)
    assert (found["trials"], found["blind"], found["success"]["n"]) == (8, 8, 8)


def test_a_second_rating_changes_no_score(plan, carry_out, rater, bench):
    carry_out(plan, 16)
    handout, _ = rating_queue.next_to_rate(rater)[:2]
    before = handout.trial.verdict_id
    rating_queue.save_rating(
        user=rater, plan=plan, code=handout.code, milestones=bench.ticks(False, False, False)
    )
    handout.trial.refresh_from_db()
    assert handout.trial.verdict_id == before
    with pytest.raises(Conflict, match="already"):
        rating_queue.save_rating(
            user=rater, plan=plan, code=handout.code, milestones=bench.ticks(True, True, True)
        )


def rated_the_other_way_round(plan, rater, bench):
    """A second rating of every trial of the sample that contradicts the operator; the trials in this order."""
    trials = []
    while (handout := rating_queue.next_to_rate(rater).found) is not None:
        reached = not handout.trial.verdict.success
        ticks = bench.ticks(True, reached, reached)
        rating_queue.save_rating(user=rater, plan=plan, code=handout.code, milestones=ticks)
        trials.append(handout.trial)
    return trials


def test_raters_agree_as_they_did_when_they_rated_whatever_was_corrected_since(plan, carry_out, rater, bench):
    carry_out(plan, 16)
    trials = rated_the_other_way_round(plan, rater, bench)
    before = rater_agreement(plan)
    assert (before["success"]["same"], before["score_alpha"] < 0) == (0, True)
    for trial in trials:
        said = trial.ratings.get()
        ticks = bench.ticks(*(reached for _, reached in said.milestones))
        services.score_trial(user=bench.operator, trial=trial, milestones=ticks, reason="the other is right")
        trial.refresh_from_db()
        assert trial.verdict.success == said.success
    assert rater_agreement(plan) == before


def test_a_correction_before_the_second_rating_is_the_score_that_it_is_held_against(
    plan, carry_out, rater, bench
):
    carry_out(plan, 16)
    trial = rating_queue.next_to_rate(rater).found.trial
    turned = not trial.verdict.success
    ticks = bench.ticks(True, turned, turned)
    services.score_trial(user=bench.operator, trial=trial, milestones=ticks, reason="I had looked away")
    rating_queue.save_rating(user=rater, plan=plan, code=trial.handout.code, milestones=ticks)
    assert rater_agreement(plan)["success"]["same"] == 1


def test_a_clock_that_was_set_back_leaves_the_first_score(plan, carry_out, rater, bench):
    carry_out(plan, 16)
    trial = rating_queue.next_to_rate(rater).found.trial
    with without_triggers("results"):
        rating_queue.save_rating(
            user=rater, plan=plan, code=trial.handout.code, milestones=bench.ticks(True, True, True)
        )
        Rating.objects.update(at=trial.verdict.scored_at - timedelta(hours=1))
    assert rater_agreement(plan)["success"]["same"] == trial.verdict.success


@pytest.fixture
def held_twice(bench):
    """Two milestones of the same words, as in scenes from before they were refused."""
    Milestone.objects.filter(scene=bench.scene, text="lifted").update(text="held")


@pytest.mark.exhaustive
def test_milestones_of_the_same_words_are_held_each_against_itself(held_twice, plan, carry_out, rater, bench):
    carry_out(plan, 16)
    trial = rating_queue.next_to_rate(rater).found.trial
    ticks = bench.ticks(*(row.reached for row in trial.verdict.outcomes.all()))
    rating_queue.save_rating(user=rater, plan=plan, code=trial.handout.code, milestones=ticks)
    said = [[row.text, row.reached, float(row.reached)] for row in trial.verdict.outcomes.all()]
    Judgement.objects.create(trial=trial, judge="seer", version="1", milestones=said)
    found, (judge,) = rater_agreement(plan)["milestones"], judge_agreement(plan)
    assert {text: (row["n"], row["same"]) for text, row in found.items()} == {
        "held": (1, 1),
        "held (2)": (1, 1),
        "on the plate": (1, 1),
    }
    assert list(judge["milestones"]) == list(found)
    assert (judge["calibration"]["n"], judge["calibration"]["brier"]) == (3, 0)


def test_who_must_not_rate_is_told_why(plan, owner, carry_out, bench, rater):
    carry_out(plan, 16)
    handout, _ = rating_queue.next_to_rate(rater)[:2]
    ticks = bench.ticks(True, True, True)
    with pytest.raises(NotAllowed, match="you ran or scored"):
        rating_queue.save_rating(user=bench.operator, plan=plan, code=handout.code, milestones=ticks)
    record_unblinding(plan, owner)
    assert rating_queue.next_to_rate(owner)[:2] == (None, 0)
    with pytest.raises(NotAllowed, match="must not know"):
        rating_queue.save_rating(user=owner, plan=plan, code=handout.code, milestones=ticks)
    with pytest.raises(NotAllowed):
        rating_queue.save_rating(
            user=builders.user("vera", "viewer"), plan=plan, code=handout.code, milestones=ticks
        )
    other = plan.handouts.exclude(slot__index__in=rating_queue.rating_sample(plan)).first()
    with pytest.raises(Conflict, match="not one of those"):
        rating_queue.save_rating(user=rater, plan=plan, code=other.code, milestones=ticks)


def test_two_trials_in_a_row_are_preferred_one_over_the_other(plan, carry_out, rater):
    carry_out(plan, 16)
    pair, left = rating_queue.next_to_compare(rater)[:2]
    assert left == 8
    assert pair.first.slot.block == pair.second.slot.block
    assert pair.first.number < pair.second.number
    codes = {"first": pair.first.code, "second": pair.second.code}
    with pytest.raises(EvaError, match="why is empty"):
        rating_queue.save_preference(user=rater, plan=plan, outcome="first", why=" ", **codes)
    with pytest.raises(EvaError, match="allowed: first, second, tie"):
        rating_queue.save_preference(user=rater, plan=plan, outcome="left", why="x", **codes)
    rating_queue.save_preference(user=rater, plan=plan, outcome="first", why="it let go gently", **codes)
    with pytest.raises(Conflict, match="already"):
        rating_queue.save_preference(user=rater, plan=plan, outcome="tie", why="x", **codes)
    with pytest.raises(Conflict, match="one after the other"):
        rating_queue.save_preference(
            user=rater, plan=plan, outcome="tie", why="x", first=codes["second"], second=codes["first"]
        )
    assert rating_queue.next_to_compare(rater).left == 7
    found = preference_ranking(plan)
    assert (found["n"], found["ranking"]) == (1, None)
    assert found["reason"]


def test_the_database_keeps_what_was_said(plan, carry_out, rater, bench):
    carry_out(plan, 16)
    handout, _ = rating_queue.next_to_rate(rater)[:2]
    rating = rating_queue.save_rating(
        user=rater, plan=plan, code=handout.code, milestones=bench.ticks(True, True, True)
    )
    with pytest.raises(Exception, match="never changed"):
        Rating.objects.filter(pk=rating.pk).update(success=False)


def test_and_what_was_preferred(plan, carry_out, rater):
    carry_out(plan, 4)
    pair, _ = rating_queue.next_to_compare(rater)[:2]
    made = rating_queue.save_preference(
        user=rater, plan=plan, outcome="tie", why="alike", first=pair.first.code, second=pair.second.code
    )
    with pytest.raises(Exception, match="never changed or removed"):
        Preference.objects.filter(pk=made.pk).delete()


def test_who_judges_once_more_because_the_answer_was_lost_gets_the_first_answer(
    plan, carry_out, rater, bench
):
    carry_out(plan, 16)
    code = rating_queue.next_to_rate(rater).found.code
    rated = {"user": rater, "plan": plan, "code": code, "milestones": bench.ticks(True, True, True)}
    pair = rating_queue.next_to_compare(rater).found
    preferred = {"user": rater, "plan": plan, "first": pair.first.code, "second": pair.second.code}
    for _ in range(2):
        rating_queue.save_rating(**rated, note="clean")
        rating_queue.save_preference(**preferred, outcome="tie", why="alike")
    assert (Rating.objects.count(), Preference.objects.count()) == (1, 1)
    with pytest.raises(Conflict, match=f"you have rated trial {code} already, with another answer"):
        rating_queue.save_rating(**rated, note="not so clean")
    with pytest.raises(
        Conflict, match=r"you have compared .* already, with another answer: the first one counts"
    ):
        rating_queue.save_preference(**preferred, outcome="first", why="alike")


def test_nobody_is_asked_about_what_cannot_be_watched(plan, carry_out, rater):
    carry_out(plan, 16)
    handout, left = rating_queue.next_to_rate(rater)[:2]
    pair, pairs = rating_queue.next_to_compare(rater)[:2]
    lost = {handout.trial.episode_id, pair.first.trial.episode_id}
    Episode.objects.filter(pk__in=lost).update(status="missing")
    again, fewer = rating_queue.next_to_rate(rater)[:2]
    other, fewer_pairs = rating_queue.next_to_compare(rater)[:2]
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
    carry_out(freeze_plan(user=owner, plan=wide), 3)
    before, after = rating_queue._pairs(wide)
    assert before[1] == after[0]
    Episode.objects.filter(trial=before[1]).update(status="missing")
    assert rating_queue._pairs(wide) == []
    assert rating_queue.next_to_compare(rater)[:2] == (None, 0)


def test_what_has_no_pictures_is_passed_over_and_named(plan, carry_out, rater, bench):
    carry_out(plan, 16)
    first, left, _ = rating_queue.next_to_rate(rater)
    preview_folder(first.trial.episode_id).rmdir()  # absent, and nobody has marked it missing
    second, still, passed = rating_queue.next_to_rate(rater)
    assert (second != first, still, passed) == (True, left, (first.code,))
    for handout in plan.handouts.exclude(pk=second.pk).exclude(pk=first.pk):
        preview_folder(handout.trial.episode_id).rmdir()
    assert rating_queue.next_to_rate(rater).found == second
    preview_folder(second.trial.episode_id).rmdir()
    none = rating_queue.next_to_rate(rater)
    assert (none.found, none.left, len(none.passed)) == (None, left, left)
    journal_folder(first.trial.episode_id).mkdir(parents=True)
    Episode.objects.filter(pk=first.trial.episode_id).update(frames=0)
    assert rating_queue.next_to_rate(rater).found is None  # it is empty
    Episode.objects.filter(pk=first.trial.episode_id).update(frames=100)  # its preview may come yet
    assert rating_queue.next_to_rate(rater)[::2] == (first, ())
    with pytest.raises(Conflict, match=f"pictures are needed to judge {first.code}: There is no preview yet"):
        rating_queue.save_rating(
            user=rater, plan=plan, code=first.code, milestones=bench.ticks(True, True, True)
        )
    assert Rating.objects.count() == 0


def test_a_pair_without_pictures_is_passed_over_and_refused(plan, carry_out, rater):
    carry_out(plan, 16)
    pair, left, _ = rating_queue.next_to_compare(rater)
    preview_folder(pair.second.trial.episode_id).rmdir()
    other, still, passed = rating_queue.next_to_compare(rater)
    assert (other != pair, still, passed) == (True, left, (pair.second.code,))
    codes = {"first": pair.first.code, "second": pair.second.code}
    with pytest.raises(Conflict, match=f"{pair.second.code}: Its folder is not on this machine"):
        rating_queue.save_preference(user=rater, plan=plan, outcome="tie", why="x", **codes)
    Episode.objects.filter(pk=pair.second.trial.episode_id).update(cameras=[])
    with pytest.raises(Conflict, match="recorded without a camera"):
        rating_queue.save_preference(user=rater, plan=plan, outcome="tie", why="x", **codes)


def test_nothing_is_kept_that_the_disk_does_not_take(plan, carry_out, rater, bench, monkeypatch):
    carry_out(plan, 16)
    handout, pair = rating_queue.next_to_rate(rater).found, rating_queue.next_to_compare(rater).found

    def full(file, payload):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(lines, "append_durably", full)
    with pytest.raises(lines.NotWritten):
        rating_queue.save_rating(
            user=rater, plan=plan, code=handout.code, milestones=bench.ticks(True, True, True)
        )
    codes = {"first": pair.first.code, "second": pair.second.code}
    with pytest.raises(lines.NotWritten):
        rating_queue.save_preference(user=rater, plan=plan, outcome="tie", why="alike", **codes)
    assert (Rating.objects.count(), Preference.objects.count()) == (0, 0)


def test_a_name_or_a_note_that_cannot_be_kept_is_refused(plan, carry_out, rater, bench):
    carry_out(plan, 16)
    handout = rating_queue.next_to_rate(rater).found
    said = {"user": rater, "plan": plan, "code": handout.code, "milestones": bench.ticks(True, True, True)}
    with pytest.raises(EvaError, match="note has 8001 characters; allowed: at most 8000"):
        rating_queue.save_rating(**said, note="x" * 8001)
    with pytest.raises(EvaError, match="U\\+0000"):
        rating_queue.save_rating(**said, failure="a\x00b")
    with pytest.raises(EvaError, match="'missed' but the trial is a success"):
        rating_queue.save_rating(**said, failure="missed")


def test_who_may_be_asked_to_rate_a_trial_rates_it_before_they_say_why_it_failed(
    plan, carry_out, rater, bench
):
    carry_out(plan, 16)
    sample = rating_queue.rating_sample(plan)
    failed = plan.handouts.filter(trial__verdict__success=False)
    other = failed.exclude(slot__index__in=sample).first()
    asked = failed.filter(slot__index__in=sample).first()
    trial_failure(user=rater, trial=other.trial, failure="slid")  # nobody rates it again
    with pytest.raises(NotAllowed, match="that may be you: rate it first"):
        trial_failure(user=rater, trial=asked.trial, failure="slid")
    form = {"user": rater, "trial": asked.trial, "reason": "not dropped"}
    as_scored = dict(asked.trial.verdict.outcomes.values_list("milestone_id", "reached"))
    with pytest.raises(NotAllowed, match="that may be you: rate it first"):
        services.score_trial(**form, milestones=as_scored, failure="slid")
    trial_failure(user=bench.operator, trial=asked.trial, failure="fell")  # who ran it is not asked
    assert rating_queue.next_to_rate(rater).left == len(sample)
    rating_queue.save_rating(
        user=rater, plan=plan, code=asked.code, milestones=bench.ticks(True, False, False)
    )
    assert trial_failure(user=rater, trial=asked.trial, failure="slid").rater == rater


@pytest.mark.exhaustive
def test_a_trial_without_pictures_is_asked_of_nobody_and_its_failure_corrected_by_anybody(
    plan, carry_out, rater
):
    carry_out(plan, 16, pictures=False)
    failed = plan.handouts.filter(
        trial__verdict__success=False, slot__index__in=rating_queue.rating_sample(plan)
    )
    assert trial_failure(user=rater, trial=failed.first().trial, failure="slid").failure == "slid"
