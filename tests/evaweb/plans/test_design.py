"""Plans whose design the server executes: who counts in which order, what ends them, what is kept at the reveal."""

import pytest
from django.db import IntegrityError, transaction

from evaweb.errors import Conflict, EvaError, NotAllowed
from evaweb.plans.allocation import hand_out
from evaweb.plans.blinding_rules import look
from evaweb.plans.canonical import digest
from evaweb.plans.design import conclusion_of, frozen, pairs_of
from evaweb.plans.models import Plan, PlanState
from evaweb.plans.services import plan_amend, plan_close, plan_freeze, plan_reveal
from evaweb.results.presentation.headline import headline
from evaweb.stations.models import Station
from evaweb.statistics.designs import conclude
from evaweb.trials import services as trials
from evaweb.trials import voids
from evaweb.trials.models import Checkpoint
from tests.evaweb.trials import builders
from tests.evaweb.unguarded import unguarded

BETTER = "pi0-new"  # succeeds always; the other one never


def frozen_plan(draft, owner, **changed):
    Plan.objects.filter(pk=draft.pk).update(**changed)
    return plan_freeze(user=owner, plan=Plan.objects.get(pk=draft.pk))


def handed(bench, plan, station=None):
    return hand_out(user=bench.operator, station=station or bench.station, plan=plan).trial


def scored(bench, trial, success=None, **said):
    won = trial.checkpoint.name == BETTER if success is None else success
    if trial.episode is None:
        builders.over(trial, 10.0)
    trials.trial_score(user=bench.operator, trial=trial, milestones=bench.ticks(True, won, won), **said)


def carry_out(bench, plan, count):
    for _ in range(count):
        scored(bench, handed(bench, plan))
    plan.refresh_from_db()


def until_it_ends(bench, plan, **said):
    """Trials, until a boundary is crossed and the next one refused; how many were made."""
    made = 0
    while conclusion_of(plan).ended != "boundary":
        scored(bench, handed(bench, plan), **said)
        made += 1
    with pytest.raises(Conflict, match="has ended: a boundary of its design was crossed"):
        handed(bench, plan)
    plan.refresh_from_db()
    return made


@pytest.fixture
def other(db):
    return Station.objects.create(name="bench-2", robot="agilex_piper", simulated=True, boot="b")


@pytest.fixture
def early(draft, owner):
    """Twenty pairs, an exact boundary, looked at after every pair."""
    return frozen_plan(draft, owner, stopping="early", repetitions=10)


def test_the_boundary_is_part_of_what_is_frozen(early):
    said = early.document["stopping"]
    assert (said["rule"], said["pairs"], said["outcome"], said["margin"]) == ("early", 20, "success", None)
    assert len(said["boundary"]) == 20
    assert frozen(early.document).boundary.error()[1] <= 0.05
    assert early.digest == digest(early.document)


def test_it_ends_by_itself_as_soon_as_a_boundary_is_crossed_and_says_not_for_which(bench, early):
    made = until_it_ends(bench, early)
    assert made < 40
    assert early.state == PlanState.CLOSED
    assert early.closed_because == f"a boundary of its design was crossed, after {made // 2} pairs"
    assert BETTER not in early.events.get(what="closed").text
    with pytest.raises(Conflict, match="has ended: a boundary of its design was crossed"):
        handed(bench, early)


def test_a_score_that_was_mistyped_can_be_corrected_before_the_next_trial_is_asked_for(bench, early):
    needed = next(n for n in range(1, 21) if conclude(frozen(early.document), [(1.0, 0.0)] * n).ended)
    carry_out(bench, early, 2 * needed)
    assert (early.state, conclusion_of(early).ended) == (PlanState.FROZEN, "boundary")
    last = early.handouts.order_by("number").last().trial
    scored(bench, last, success=last.checkpoint.name != BETTER, reason="the wrong key")
    carry_out(bench, early, 1)
    assert (early.state, conclusion_of(early).ended) == (PlanState.FROZEN, "")


def test_a_trial_that_is_under_way_elsewhere_is_finished_first_and_changes_nothing(bench, early, other):
    pair = [handed(bench, early, other)]
    scored(bench, pair[0])
    waiting = handed(bench, early, other)  # the second of the first block
    for _ in range(20):
        scored(bench, handed(bench, early))
    early.refresh_from_db()
    assert early.state == PlanState.FROZEN
    assert pairs_of(early) == []  # the first block is not made: what was finished before it does not enter
    scored(bench, waiting)
    with pytest.raises(Conflict, match="has ended"):
        handed(bench, early)
    early.refresh_from_db()
    assert early.state == PlanState.CLOSED
    assert conclusion_of(early).at < 11
    assert len(pairs_of(early)) == 11


def test_while_its_last_trial_runs_no_other_is_handed_out(bench, early, other):
    needed = next(n for n in range(1, 21) if conclude(frozen(early.document), [(1.0, 0.0)] * n).ended)
    carry_out(bench, early, 2 * needed - 1)
    late = handed(bench, early, other)  # of the next block
    carry_out(bench, early, 1)
    assert (early.state, conclusion_of(early).at) == (PlanState.FROZEN, needed)
    with pytest.raises(
        Conflict, match=f"has ended: a boundary of its design was crossed, after {needed} pairs"
    ):
        handed(bench, early)
    trials.trial_abandon(user=bench.operator, trial=late)
    with pytest.raises(Conflict, match="has ended"):
        handed(bench, early)
    early.refresh_from_db()
    assert early.state == PlanState.CLOSED


def test_all_pairs_made_close_it_too(bench, draft, owner):
    plan = frozen_plan(draft, owner, stopping="late", repetitions=1)
    carry_out(bench, plan, 4)
    assert plan.closed_because == "all pairs of its comparison are made, after 2 pairs"
    assert headline(plan).sentence.startswith(
        f"No significant difference between {BETTER} and pi0-block: 2/2"
    )


def test_a_fixed_plan_of_three_makes_all_its_trials_and_says_not_what_they_show(bench, draft, owner):
    draft.checkpoints.add(Checkpoint.objects.create(name="pi0-third", policy={}))
    plan = frozen_plan(draft, owner, repetitions=4)
    carry_out(bench, plan, 23)
    assert plan.state == PlanState.FROZEN
    carry_out(bench, plan, 1)
    assert plan.closed_because == "all pairs of its comparison are made, after 8 pairs"
    assert headline(plan).sentence.startswith(f"{BETTER} succeeded more often")


def test_closed_before_its_design_ended_it_concludes_nothing(bench, draft, owner):
    plan = frozen_plan(draft, owner, stopping="evidence", repetitions=20)
    carry_out(bench, plan, 6)
    assert headline(plan).sentence.endswith("3 of 40 pairs are made, and the design goes on")
    plan_close(user=owner, plan=plan, reason="the gripper broke")
    said = f"{BETTER} and pi0-block were not compared: closed after 3 of 40 pairs, before the design ended"
    assert headline(plan).sentence == said


def test_a_fixed_number_says_nothing_before_its_end_however_clear_it_is(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=10)
    carry_out(bench, plan, 38)
    assert "not compared yet: 19 of 20 pairs" in headline(plan).sentence
    carry_out(bench, plan, 2)
    assert headline(plan).sentence.startswith(
        f"{BETTER} succeeded more often than pi0-block: 20/20 against 0/20"
    )


def test_what_is_corrected_after_the_reveal_makes_no_other_headline(bench, early, owner):
    until_it_ends(bench, early)
    plan_reveal(user=owner, plan=early)
    before = headline(early)
    assert before.corrected == ""
    held = {name: early.at_reveal[name] for name in ("pairs", "arms")}
    assert early.at_reveal["digest"] == digest({"plan": early.digest, **held})
    for handout in early.handouts.all():
        scored(bench, handout.trial, success=True, reason="looked again")
    after = headline(early)
    assert after.sentence == before.sentence
    assert after.corrected.startswith(f"{BETTER} and pi0-block were not compared")
    with pytest.raises(IntegrityError, match="never changed"), transaction.atomic():
        Plan.objects.filter(pk=early.pk).update(at_reveal=None)


def test_a_user_who_has_looked_changes_no_score_before_the_reveal(bench, early, owner):
    carry_out(bench, early, 4)
    trial = early.handouts.first().trial
    look(early, owner)
    for what in (
        lambda: trials.trial_score(
            user=owner, trial=trial, milestones=bench.ticks(True, False, False), reason="looked again"
        ),
        lambda: voids.trial_void(user=owner, trial=trial, reason="it looks bad"),
    ):
        with pytest.raises(NotAllowed, match="you have seen results"):
            what()
    plan_close(user=owner, plan=early, reason="enough")
    again = plan_amend(user=owner, plan=early, reason="more trials")
    plan_freeze(user=owner, plan=again)
    with pytest.raises(NotAllowed, match="you have seen results"):
        hand_out(user=owner, station=bench.station, plan=again)


def test_a_correction_before_the_reveal_is_told_beside_the_headline(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=4)
    carry_out(bench, plan, 16)
    first = next(h.trial for h in plan.handouts.all() if h.trial.checkpoint.name == BETTER)
    scored(bench, first, success=False, reason="it fell later")
    plan_reveal(user=owner, plan=plan)
    said = headline(plan)
    assert "7/8 against 0/8" in said.sentence
    assert "8/8 against 0/8" in said.at_first


def test_the_better_one_is_named_first_with_its_numbers(bench, draft, owner):
    draft.first, draft.second = draft.second, draft.first
    plan = frozen_plan(draft, owner, repetitions=4)
    carry_out(bench, plan, 16)
    said = headline(plan).sentence
    assert said.startswith(
        f"{BETTER} succeeded more often than pi0-block: 8/8 against 0/8, difference 100 points ["
    )


def test_versions_before_it_are_told(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=4)
    carry_out(bench, plan, 6)
    again = plan_amend(user=owner, plan=plan, reason="another lamp")
    again = plan_freeze(user=owner, plan=again)
    carry_out(bench, again, 16)
    (told,) = headline(again).versions
    assert told.startswith(f"Version 1: {BETTER} and pi0-block were not compared: closed after 3 of 8 pairs")
    assert told.endswith("Amended because: another lamp")
    assert headline(plan).versions == ()


def test_a_second_reveal_of_a_database_that_was_put_back_keeps_the_first(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=4)
    carry_out(bench, plan, 16)
    plan_reveal(user=owner, plan=plan)
    first = plan.at_reveal
    with unguarded("plans"):
        Plan.objects.filter(pk=plan.pk).update(
            state=PlanState.CLOSED, at_reveal=None, revealed_at=None, revealed_by=None
        )
    for handout in plan.handouts.all():
        scored(bench, handout.trial, success=True, reason="looked again")
    plan.refresh_from_db()
    plan_reveal(user=owner, plan=plan)
    assert plan.at_reveal == first
    assert "what counts is that of the reveal of" in plan.events.filter(what="revealed").last().text
    assert "8/8 against 8/8" in headline(plan).corrected


def test_checkpoints_that_swapped_their_names_run_nothing_and_reveal_nothing(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=4)
    one, other = draft.first, draft.second
    Checkpoint.objects.filter(pk=other.pk).update(policy=one.policy)  # as if both had been the same all along
    for row, name in ((one, "aside"), (other, BETTER), (one, "pi0-block")):
        Checkpoint.objects.filter(pk=row.pk).update(name=name)
    with pytest.raises(Conflict, match="was renamed since"):
        handed(bench, plan)
    plan_close(user=owner, plan=plan, reason="enough")
    with pytest.raises(EvaError, match="not called what they were"):
        plan_reveal(user=owner, plan=plan)


def test_what_is_kept_of_a_revealed_plan_stays(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=1)
    carry_out(bench, plan, 4)
    plan_reveal(user=owner, plan=plan)
    for change in ({"closed_because": "enough"}, {"revealed_at": None}, {"owner": bench.operator}):
        with pytest.raises(IntegrityError), transaction.atomic():
            Plan.objects.filter(pk=plan.pk).update(**change)


def test_not_worse_by_the_margin(bench, draft, owner):
    plan = frozen_plan(draft, owner, stopping="late", margin=0.5, repetitions=8)
    until_it_ends(bench, plan, success=True)
    said = f"{BETTER} is not worse than pi0-block by 50 points or more: "
    assert headline(plan).sentence.startswith(said)


def test_designs_that_cannot_be_are_said_before_the_freeze(draft, owner):
    for changed, words in (
        ({"stopping": "late", "repetitions": 200}, "400 pairs of a design with an exact boundary"),
        ({"stopping": "late", "outcome": "score"}, "outcome = 'score' with a boundary of successes"),
        ({"look_after": [3, "x"]}, r"looks = \[3, 'x'\]; allowed: a list of numbers of pairs"),
        ({"first": None, "second": None, "margin": 0.1}, "needs the comparison that it is about"),
    ):
        with transaction.atomic():
            with pytest.raises(EvaError, match=words):
                frozen_plan(draft, owner, **changed)
            transaction.set_rollback(True)


def test_an_amendment_keeps_the_design(early, owner):
    made = plan_amend(user=owner, plan=early, reason="the plate was replaced")
    assert (made.stopping, made.outcome, made.margin, made.look_after) == ("early", "success", None, [])


def test_a_plan_from_before_there_were_boundaries_is_read(bench, early):
    document = {**early.document, "stopping": {"rule": "evidence", "alpha": 0.05}}
    found = frozen(document)
    assert (found.rule, found.pairs, found.boundary) == ("evidence", 20, None)
    assert frozen({**document, "comparison": None}) is None
