"""Plans whose design the server executes: who counts in which order, what ends them, what is kept at the reveal."""

import pytest
from django.db import IntegrityError, transaction

from evaweb.core.canonical_json import digest
from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.plans import services
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.blinding_rules import record_unblinding
from evaweb.plans.design import current_pairs, dropped_of, findings_of, frozen_design
from evaweb.plans.frozen_document import UnevenError, document_of
from evaweb.plans.models import Plan, PlanState
from evaweb.plans.services import amend_plan, close_plan, freeze_plan, reveal_plan
from evaweb.results.analysis.caching import cached_analysis, corrected_of
from evaweb.results.analysis.filters import TrialFilter
from evaweb.results.presentation.alternatives import headline_alternatives
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.stations.models import Station
from evaweb.statistics.designs import evaluate_design, in_blocks
from evaweb.trials import services as trials
from evaweb.trials import voids
from evaweb.trials.models import Checkpoint
from tests.evaweb.trials import builders
from tests.evaweb.unguarded import without_triggers

BETTER = "pi0-new"  # succeeds always; the other one never


def frozen_plan(draft, owner, **changed):
    Plan.objects.filter(pk=draft.pk).update(**changed)
    return freeze_plan(user=owner, plan=Plan.objects.get(pk=draft.pk))


def handed(bench, plan, station=None):
    return allocate_trial(user=bench.operator, station=station or bench.station, plan=plan).trial


def scored(bench, trial, success=None, **said):
    won = trial.checkpoint.name == BETTER if success is None else success
    if trial.episode is None:
        builders.finished_trial(trial, 10.0)
    trials.score_trial(user=bench.operator, trial=trial, milestones=bench.ticks(True, won, won), **said)


def carry_out(bench, plan, count):
    for _ in range(count):
        scored(bench, handed(bench, plan))
    plan.refresh_from_db()


def until_it_ends(bench, plan, **said):
    """Trials, until a boundary is crossed and the next one refused; how many were made."""
    made = 0
    while findings_of(plan).ended != "boundary":
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
    assert frozen_design(early.document).boundary.error()[1] <= 0.05
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
    needed = next(
        n
        for n in range(1, 21)
        if evaluate_design(frozen_design(early.document), in_blocks([(1.0, 0.0)] * n)).ended
    )
    carry_out(bench, early, 2 * needed)
    assert (early.state, findings_of(early).ended) == (PlanState.FROZEN, "boundary")
    last = early.handouts.order_by("number").last().trial
    scored(bench, last, success=last.checkpoint.name != BETTER, reason="the wrong key")
    carry_out(bench, early, 1)
    assert (early.state, findings_of(early).ended) == (PlanState.FROZEN, "")


@pytest.mark.exhaustive
def test_a_trial_that_is_under_way_elsewhere_is_finished_first_and_changes_nothing(bench, early, other):
    pair = [handed(bench, early, other)]
    scored(bench, pair[0])
    waiting = handed(bench, early, other)  # the second of the first block
    for _ in range(20):
        scored(bench, handed(bench, early))
    early.refresh_from_db()
    assert early.state == PlanState.FROZEN
    assert (
        current_pairs(early).counted == []
    )  # the first block is not made: what was finished before it does not enter
    scored(bench, waiting)
    with pytest.raises(Conflict, match="has ended"):
        handed(bench, early)
    early.refresh_from_db()
    assert early.state == PlanState.CLOSED
    assert findings_of(early).at < 11
    assert len(current_pairs(early).counted) == 11


def test_while_its_last_trial_runs_no_other_is_handed_out(bench, early, other):
    needed = next(
        n
        for n in range(1, 21)
        if evaluate_design(frozen_design(early.document), in_blocks([(1.0, 0.0)] * n)).ended
    )
    carry_out(bench, early, 2 * needed - 1)
    late = handed(bench, early, other)  # of the next block
    carry_out(bench, early, 1)
    assert (early.state, findings_of(early).at) == (PlanState.FROZEN, needed)
    with pytest.raises(
        Conflict, match=f"has ended: a boundary of its design was crossed, after {needed} pairs"
    ):
        handed(bench, early)
    trials.abandon_trial(user=bench.operator, trial=late)
    with pytest.raises(Conflict, match="has ended"):
        handed(bench, early)
    early.refresh_from_db()
    assert early.state == PlanState.CLOSED


def test_whatever_is_corrected_after_an_ask_has_found_its_end_the_next_ask_finds_the_same(
    bench, early, other
):
    """Else who corrects a score to and fro, with a trial left prepared elsewhere, knows which checkpoint it was of."""
    needed = next(
        n
        for n in range(1, 21)
        if evaluate_design(frozen_design(early.document), in_blocks([(1.0, 0.0)] * n)).ended
    )
    carry_out(bench, early, 2 * needed - 1)
    late = handed(bench, early, other)
    carry_out(bench, early, 1)
    ended = f"has ended: a boundary of its design was crossed, after {needed} pairs"
    with pytest.raises(Conflict, match=ended):
        handed(bench, early)
    for trial in [row.trial for row in early.handouts.order_by("number")][:4]:
        won = trial.checkpoint.name == BETTER
        scored(bench, trial, success=not won, reason="was it?")
        with pytest.raises(Conflict, match=ended):
            handed(bench, early)
        scored(bench, trial, success=won, reason="it was not")
    trials.abandon_trial(user=bench.operator, trial=late)
    early.refresh_from_db()
    assert (early.state, early.closed_because) == (PlanState.CLOSED, ended.removeprefix("has ended: "))
    assert [event.what for event in early.events.all()].count("ended") == 1


def test_while_its_station_has_a_trial_to_finish_an_ask_says_that_and_nothing_of_the_design(bench, early):
    needed = next(
        n
        for n in range(1, 21)
        if evaluate_design(frozen_design(early.document), in_blocks([(1.0, 0.0)] * n)).ended
    )
    carry_out(bench, early, 2 * needed - 1)
    last = handed(bench, early)
    said = []
    for won in (True, False):  # of a trial of before, whose block is made
        first = early.handouts.order_by("number").first().trial
        scored(bench, first, success=won, reason=f"{won}")
        with pytest.raises(Conflict) as asked:
            handed(bench, early)
        said.append(str(asked.value))
    assert said[0] == said[1]
    assert f"trial {last.pk} of bench-1 is" in said[0]
    assert not early.events.filter(what="ended").exists()


def test_all_pairs_made_close_it_too(bench, draft, owner):
    plan = frozen_plan(draft, owner, stopping="late", repetitions=1)
    carry_out(bench, plan, 4)
    assert plan.closed_because == "all pairs of its comparison are made, after 2 pairs"
    assert PlanResult(plan).headline.sentence.startswith(
        f"Undecided: 2 pairs cannot tell {BETTER} and pi0-block apart: 2/2"
    )


@pytest.mark.exhaustive
def test_a_fixed_plan_of_three_makes_all_its_trials_and_says_not_what_they_show(bench, draft, owner):
    draft.checkpoints.add(Checkpoint.objects.create(name="pi0-third", policy={}))
    plan = frozen_plan(draft, owner, repetitions=4)
    carry_out(bench, plan, 23)
    assert plan.state == PlanState.FROZEN
    carry_out(bench, plan, 1)
    assert plan.closed_because == "all pairs of its comparison are made, after 8 pairs"
    assert PlanResult(plan).headline.sentence.startswith(f"{BETTER} succeeded more often")


def test_closed_before_its_design_ended_it_concludes_nothing(bench, draft, owner):
    plan = frozen_plan(draft, owner, stopping="evidence", repetitions=20)
    carry_out(bench, plan, 6)
    assert PlanResult(plan).headline.sentence.endswith("3 of 40 pairs are made, and the design goes on")
    close_plan(user=owner, plan=plan, reason="the gripper broke")
    said = f"{BETTER} and pi0-block were not compared: closed after 3 of 40 pairs, before the design ended"
    assert PlanResult(plan).headline.sentence == said


def test_a_fixed_number_says_nothing_before_its_end_however_clear_it_is(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=10)
    carry_out(bench, plan, 38)
    assert "not compared yet: 19 of 20 pairs" in PlanResult(plan).headline.sentence
    carry_out(bench, plan, 2)
    assert PlanResult(plan).headline.sentence.startswith(
        f"{BETTER} succeeded more often than pi0-block: 20/20 against 0/20"
    )


def test_what_is_corrected_after_the_reveal_makes_no_other_headline(bench, early, owner):
    until_it_ends(bench, early)
    reveal_plan(user=owner, plan=early)
    before = PlanResult(early).headline
    assert before.corrected == ""
    apart = ("digest", "at", "by", "commitment", "key")
    held = {name: value for name, value in early.at_reveal.items() if name not in apart}
    assert early.at_reveal["digest"] == digest({"plan": early.digest, **held})
    figures = cached_analysis(early)
    assert corrected_of(early, TrialFilter()) == {}
    for handout in early.handouts.all():
        scored(bench, handout.trial, success=True, reason="looked again")
    after = PlanResult(early).headline
    assert after.sentence == before.sentence
    assert after.corrected.startswith(f"{BETTER} and pi0-block would not be compared yet")
    now = cached_analysis(early)
    assert [arm.success for arm in now.arms] == [arm.success for arm in figures.arms]
    assert (now.letters, now.comparisons) == (figures.letters, figures.comparisons)
    corrected = corrected_of(early, TrialFilter())
    assert {name: found.successes == found.n for name, found in corrected.items()} == {"pi0-block": True}
    with pytest.raises(IntegrityError, match="never changed"), transaction.atomic():
        Plan.objects.filter(pk=early.pk).update(at_reveal=None)


def test_what_counts_of_a_plan_that_is_not_blind_is_kept_at_its_close(
    bench, draft, owner, django_capture_on_commit_callbacks
):
    plan = frozen_plan(draft, owner, blind=False, repetitions=2)
    with django_capture_on_commit_callbacks(execute=True):
        carry_out(bench, plan, 8)
    plan.refresh_from_db()
    kept, said = plan.at_reveal, PlanResult(plan).headline
    assert (plan.state, kept["by"], kept["headline"]) == (
        "closed",
        bench.operator.username,
        list(said.sentences),
    )
    trial = next(handout.trial for handout in plan.handouts.all() if handout.trial.checkpoint.name == BETTER)
    scored(bench, trial, success=False, reason="looked again")
    assert PlanResult(plan).headline.sentence == said.sentence
    assert "3/4 against 0/4" in PlanResult(plan).headline.corrected
    plan = reveal_plan(user=owner, plan=plan)
    assert plan.at_reveal == kept
    assert "what counts is that of the close of" in plan.events.get(what="revealed").text


def test_a_user_who_has_looked_changes_no_score_before_the_reveal(bench, early, owner):
    carry_out(bench, early, 4)
    trial = early.handouts.first().trial
    record_unblinding(early, owner)
    for what in (
        lambda: trials.score_trial(
            user=owner, trial=trial, milestones=bench.ticks(True, False, False), reason="looked again"
        ),
        lambda: voids.void_trial(user=owner, trial=trial, reason="it looks bad"),
    ):
        with pytest.raises(NotAllowed, match="you have seen results"):
            what()
    close_plan(user=owner, plan=early, reason="enough")
    again = amend_plan(user=owner, plan=early, reason="more trials")
    freeze_plan(user=owner, plan=again)
    with pytest.raises(NotAllowed, match="you have seen results"):
        allocate_trial(user=owner, station=bench.station, plan=again)


def test_a_correction_before_the_reveal_is_told_beside_the_headline(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=4)
    carry_out(bench, plan, 16)
    first = next(h.trial for h in plan.handouts.all() if h.trial.checkpoint.name == BETTER)
    scored(bench, first, success=False, reason="it fell later")
    reveal_plan(user=owner, plan=plan)
    said = PlanResult(plan).headline
    assert "7/8 against 0/8" in said.sentence
    assert "8/8 against 0/8" in said.at_first


@pytest.mark.exhaustive
def test_the_better_one_is_named_first_with_its_numbers(bench, draft, owner):
    draft.first, draft.second = draft.second, draft.first
    plan = frozen_plan(draft, owner, repetitions=4)
    carry_out(bench, plan, 16)
    said = PlanResult(plan).headline.sentence
    assert said.startswith(
        f"{BETTER} succeeded more often than pi0-block: 8/8 against 0/8, difference 100 points ["
    )


def test_versions_before_it_are_told(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=4)
    carry_out(bench, plan, 6)
    again = amend_plan(user=owner, plan=plan, reason="another lamp")
    again = freeze_plan(user=owner, plan=again)
    carry_out(bench, again, 16)
    (told,) = PlanResult(again).headline.versions
    assert told.startswith(f"Version 1: {BETTER} and pi0-block were not compared: closed after 3 of 8 pairs")
    assert told.endswith("Amended because: another lamp")
    assert PlanResult(plan).headline.versions == ()


@pytest.mark.exhaustive
def test_a_second_reveal_of_a_database_that_was_put_back_keeps_the_first(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=4)
    carry_out(bench, plan, 16)
    reveal_plan(user=owner, plan=plan)
    first = plan.at_reveal
    with without_triggers("plans"):
        Plan.objects.filter(pk=plan.pk).update(
            state=PlanState.CLOSED, at_reveal=None, revealed_at=None, revealed_by=None
        )
    for handout in plan.handouts.all():
        scored(bench, handout.trial, success=True, reason="looked again")
    plan.refresh_from_db()
    reveal_plan(user=owner, plan=plan)
    assert plan.at_reveal == first
    assert "what counts is that of the reveal of" in plan.events.filter(what="revealed").last().text
    assert "8/8 against 8/8" in PlanResult(plan).headline.corrected


def test_checkpoints_that_swapped_their_names_run_nothing_and_reveal_nothing(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=4)
    one, other = draft.first, draft.second
    Checkpoint.objects.filter(pk=other.pk).update(policy=one.policy)  # as if both had been the same all along
    for row, name in ((one, "aside"), (other, BETTER), (one, "pi0-block")):
        Checkpoint.objects.filter(pk=row.pk).update(name=name)
    with pytest.raises(Conflict, match="was renamed since"):
        handed(bench, plan)
    close_plan(user=owner, plan=plan, reason="enough")
    with pytest.raises(EvaError, match="not called what they were"):
        reveal_plan(user=owner, plan=plan)


def test_what_is_kept_of_a_revealed_plan_stays(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=1)
    carry_out(bench, plan, 4)
    reveal_plan(user=owner, plan=plan)
    for change in ({"closed_because": "enough"}, {"revealed_at": None}, {"owner": bench.operator}):
        with pytest.raises(IntegrityError), transaction.atomic():
            Plan.objects.filter(pk=plan.pk).update(**change)


def test_not_worse_by_the_margin(bench, draft, owner):
    plan = frozen_plan(draft, owner, stopping="late", margin=0.5, repetitions=8)
    until_it_ends(bench, plan, success=True)
    said = f"{BETTER} is not worse than pi0-block by 50 points or more: "
    assert PlanResult(plan).headline.sentence.startswith(said)


def test_designs_that_cannot_be_are_said_before_the_freeze(draft, owner):
    for changed, words in (
        ({"stopping": "late", "repetitions": 200}, "400 pairs of a design with an exact boundary"),
        ({"stopping": "late", "outcome": "score"}, "outcome = 'score' with a boundary of successes"),
        ({"look_after": [3, "x"]}, r"looks = \[3, 'x'\]; allowed: a list of rising numbers of pairs"),
        ({"first": None, "second": None, "margin": 0.1}, "needs the comparison that it is about"),
    ):
        with transaction.atomic():
            with pytest.raises(EvaError, match=words):
                frozen_plan(draft, owner, **changed)
            transaction.set_rollback(True)


def test_an_amendment_keeps_the_design(early, owner):
    made = amend_plan(user=owner, plan=early, reason="the plate was replaced")
    assert (made.stopping, made.outcome, made.margin, made.look_after) == ("early", "success", None, [])


def test_a_plan_from_before_there_were_boundaries_is_read(bench, early):
    document = {**early.document, "stopping": {"rule": "evidence", "alpha": 0.05}}
    found = frozen_design(document)
    assert (found.rule, found.blocks, found.boundary) == ("evidence", 20, None)
    del document["comparisons"]
    assert frozen_design({**document, "comparison": [BETTER, "pi0-block"]}) == found
    assert frozen_design({**document, "comparison": None}) is None


def test_a_plan_does_not_close_itself_on_a_repetition_whose_trial_may_count_yet(bench, early, owner):
    first = handed(bench, early)
    while first.checkpoint.name != BETTER:
        scored(bench, first)
        first = handed(bench, early)
    scored(bench, first, success=False)
    voids.void_trial(user=bench.operator, trial=first, reason="the plate had slipped")
    while findings_of(early).ended != "boundary":
        scored(bench, handed(bench, early))
    with pytest.raises(Conflict, match=f"closed once the void of trial {first.pk} is answered"):
        handed(bench, early)
    early.refresh_from_db()
    assert early.state == PlanState.FROZEN
    voids.answer_void(user=builders.user("sam"), trial=first, agree=False, reason="it had not")
    assert findings_of(early).ended == ""  # with the failure it goes on
    scored(bench, handed(bench, early))


@pytest.mark.exhaustive
def test_the_worst_of_what_was_thrown_away_is_held_against_what_the_reveal_kept(bench, draft, owner):
    plan = frozen_plan(draft, owner, repetitions=5)
    thrown = handed(bench, plan)
    while thrown.checkpoint.name != BETTER:
        scored(bench, thrown)
        thrown = handed(bench, plan)
    builders.finished_trial(thrown, 9.0)
    voids.void_trial(user=bench.operator, trial=thrown, reason="the plate had slipped")
    while plan.state == PlanState.FROZEN:
        scored(bench, handed(bench, plan))
        plan.refresh_from_db()
    reveal_plan(user=owner, plan=plan)
    plan.refresh_from_db()
    before = PlanResult(plan).headline.worst
    assert "9/10 against 0/10" in before
    for handout in plan.handouts.filter(slot__checkpoint__name=BETTER, trial__status="scored")[:6]:
        scored(bench, handout.trial, success=False, reason="looked again")
    assert PlanResult(plan).headline.worst == before
    assert "4/10 against 0/10" in PlanResult(plan).headline.corrected


# --- several comparisons, dropped checkpoints, random order ---------------------------------------------------------


@pytest.fixture
def three(draft):
    """Three checkpoints: one always succeeds, one in every second block, one never."""
    draft.checkpoints.add(Checkpoint.objects.create(name="pi0-third", policy={}))
    draft.first = draft.second = None
    draft.save()
    return draft


def won(trial):
    return {BETTER: True, "pi0-third": trial.handout.slot.block % 2 == 0}.get(trial.checkpoint.name, False)


def carry_out_three(bench, plan):
    """Trials until no more is handed out; the checkpoints of each block that was begun."""
    blocks = {}
    while plan.state == PlanState.FROZEN:
        try:
            trial = handed(bench, plan)
        except Conflict:
            plan.refresh_from_db()
            assert plan.state == PlanState.CLOSED
            break
        blocks.setdefault(trial.handout.slot.block, []).append(trial.checkpoint.name)
        scored(bench, trial, success=won(trial))
        plan.refresh_from_db()
    return blocks


@pytest.mark.exhaustive
def test_all_checkpoints_are_compared_and_one_that_was_found_worse_is_tried_no_more(bench, three, owner):
    plan = frozen_plan(three, owner, stopping="early", comparing="all", drop_arms=True, repetitions=20)
    assert plan.document["comparisons"] == [
        ["pi0-block", BETTER],
        ["pi0-block", "pi0-third"],
        [BETTER, "pi0-third"],
    ]
    blocks = carry_out_three(bench, plan)
    sizes = [len(names) for _, names in sorted(blocks.items())]
    assert sizes == sorted(sizes, reverse=True)
    assert set(sizes) == {2, 3}
    at = sizes.index(2)
    assert all("pi0-block" not in names for block, names in blocks.items() if block >= at)
    assert dropped_of(plan) == {"pi0-block": at}
    said = PlanResult(plan).headline
    first, second, third = said.sentences
    assert first.startswith(f"{BETTER} succeeded more often than pi0-block: {at}/{at} against 0/{at}")
    assert second.endswith("when one of them was dropped")
    assert third.startswith(f"{BETTER} succeeded more often than pi0-third")
    assert said.letters == ((BETTER, "a"), ("pi0-third", "b"), ("pi0-block", "b"))
    assert "shared by 3 comparisons" in said.method
    assert "pi0" not in plan.closed_because
    reveal_plan(user=owner, plan=plan)
    assert PlanResult(plan).headline.sentences == said.sentences


def until_one_is_dropped(bench, plan, stations):
    """Trials, block by block at one station after the other, until a checkpoint is dropped; it, and after how many."""
    made = 0
    while not (dropped := dropped_of(plan)):
        trial = handed(bench, plan, stations[made // 3 % len(stations)])
        scored(bench, trial, success=won(trial))
        made += 1
    ((name, at),) = dropped.items()
    return name, at


@pytest.mark.exhaustive
def test_a_boundary_that_ends_a_plan_with_drops_closes_it_when_the_next_trial_is_asked_for(
    bench, three, owner
):
    plan = frozen_plan(three, owner, stopping="early", comparing="all", drop_arms=True, repetitions=20)
    while not findings_of(plan).ended:
        last = handed(bench, plan)
        scored(bench, last, success=won(last))
    plan.refresh_from_db()
    assert plan.state == PlanState.FROZEN
    scored(bench, last, success=not won(last), reason="mistyped")
    plan.refresh_from_db()
    assert (plan.state, findings_of(plan).ended) == (PlanState.FROZEN, "")
    assert handed(bench, plan).handout.slot.block == last.handout.slot.block + 1


def test_while_a_trial_is_repeated_a_dropped_checkpoint_stays_dropped(bench, three, owner):
    other = Station.objects.create(name="bench-2", robot="agilex_piper", simulated=True, boot="b")
    plan = frozen_plan(three, owner, stopping="early", comparing="all", drop_arms=True, repetitions=20)
    name, at = until_one_is_dropped(bench, plan, [bench.station, other])
    for station in (bench.station, bench.station, other, other):  # blocks that have a trial less
        scored(bench, handed(bench, plan, station), success=True)
    of_it = plan.handouts.filter(slot__checkpoint__name=name).order_by("number")
    others = plan.handouts.exclude(slot__checkpoint__name=name).order_by("number")
    for voided in (others.first(), of_it.first()):
        voids.void_trial(user=bench.operator, trial=voided.trial, reason="a camera had moved")
        assert dropped_of(plan) == {name: at}
        elsewhere = other if voided.trial.station == bench.station else bench.station
        following = handed(bench, plan, elsewhere)
        assert (following.checkpoint.name == name, following.handout.slot.block > at) == (False, True)
        scored(bench, following, success=True)
        again = handed(bench, plan, voided.trial.station)
        assert again.handout.slot_id == voided.slot_id
        scored(bench, again, success=voided.trial.verdict.success)


@pytest.mark.some(1)
@pytest.mark.parametrize("margin", [None, 0.4])
def test_a_control_stays_whatever_is_found_of_it(bench, three, owner, margin):
    control = Checkpoint.objects.get(name="pi0-block")
    plan = frozen_plan(
        three,
        owner,
        stopping="early",
        comparing="control",
        drop_arms=True,
        repetitions=20,
        margin=margin,
        first=control,
    )
    blocks = carry_out_three(bench, plan)
    ends = {
        names[0]: one.ended_at_pair
        for names, one in zip(plan.document["comparisons"], findings_of(plan).each, strict=True)
    }
    assert ends[BETTER] < ends["pi0-third"]
    assert all(control.name in names for names in blocks.values())
    assert {BETTER in blocks[block] for block in range(ends[BETTER], len(blocks))} == {False}
    assert not any(one.dropped for one in findings_of(plan).each)
    assert dropped_of(plan) == {BETTER: ends[BETTER]}


@pytest.mark.exhaustive
def test_doubts_of_a_plan_that_dropped_a_checkpoint_are_judged_comparison_by_comparison(bench, three, owner):
    plan = frozen_plan(three, owner, stopping="early", comparing="all", drop_arms=True, repetitions=20)
    bob, thrown = builders.user("bob"), None
    while plan.state == PlanState.FROZEN:
        user = bench.operator if dropped_of(plan) else bob
        try:
            trial = allocate_trial(user=user, station=bench.station, plan=plan).trial
        except Conflict:
            break
        builders.finished_trial(trial, 9.0)
        if thrown is None and dropped_of(plan) and trial.checkpoint.name == BETTER:
            thrown = voids.void_trial(user=user, trial=trial, reason="the plate had slipped")
            continue
        trials.score_trial(user=user, trial=trial, milestones=bench.ticks(True, won(trial), won(trial)))
        plan.refresh_from_db()
    reveal_plan(user=owner, plan=Plan.objects.get(pk=plan.pk))
    plan.refresh_from_db()
    ways = {row["what"]: row for row in headline_alternatives(plan, {})}
    worst = ways.pop("attempts discarded unscored counted against it")
    assert f"{BETTER} and pi0-third" in worst["sentence"]
    assert not any("closed after" in row["sentence"] or "go on" in row["sentence"] for row in ways.values())
    first = ways["only first attempts"]
    assert first["sentence"].count(f"{BETTER} succeeded more often than") == 2
    assert first["same"] is True
    alone = ways[f"without operator {bench.operator.username}"]
    assert f"{BETTER} succeeded more often than pi0-block" in alone["sentence"]
    assert ways["without operator bob"]["same"] is None
    assert ways["without operator bob"]["sentence"].startswith(f"No pair of pi0-block and {BETTER} is left")


@pytest.mark.exhaustive
def test_each_checkpoint_is_compared_with_the_first_at_its_share_of_alpha(bench, three, owner):
    three.first = Checkpoint.objects.get(name="pi0-third")
    three.save()
    plan = frozen_plan(three, owner, comparing="control", repetitions=6)
    assert plan.document["comparisons"] == [["pi0-block", "pi0-third"], [BETTER, "pi0-third"]]
    carry_out_three(bench, plan)
    found = findings_of(plan)
    assert [one.ended_at_pair for one in found.each] == [12, 12]
    assert all(one.p is not None for one in found.each)
    assert [one.winner for one in found.each] == [
        "second" if found.each[0].p <= 0.025 else None,
        "first" if found.each[1].p <= 0.025 else None,
    ]
    assert PlanResult(plan).headline.letters == ()


@pytest.mark.exhaustive
def test_checkpoints_in_random_order_are_judged_by_the_numbers_that_were_drawn(bench, draft, owner):
    plan = frozen_plan(draft, owner, stopping="early", allocation="random", repetitions=20)
    said = plan.document["stopping"]
    assert said["counts"][-1] == [
        plan.slots.filter(checkpoint__name=name).count() for name in (BETTER, "pi0-block")
    ]
    assert len(said["counts"]) == 40
    assert [row[:2] for row in said["boundary"]] == [count for count in said["counts"] if min(count) > 0]
    sizes = {len({slot.checkpoint_id for slot in plan.slots.filter(block=block)}) for block in range(40)}
    assert sizes == {1, 2}
    made = until_it_ends(bench, plan)
    assert made < 80
    assert plan.closed_because == f"a boundary of its design was crossed, after {made // 2} blocks"
    numbers = [row.trial.number for row in plan.handouts.filter(slot__block=0)]
    assert numbers == [1, 2]  # which tells not whether both are of one checkpoint
    assert PlanResult(plan).headline.sentence.startswith(f"{BETTER} succeeded more often than pi0-block: ")
    assert PlanResult(plan).headline.sentence.endswith(f"after {made // 2} of 40 blocks")
    again = amend_plan(user=owner, plan=plan, reason="another lamp")
    frozen_plan(again, owner, repetitions=15)
    told = again.events.get(what="frozen").text
    assert "repetitions: 20 -> 15" in told
    assert "counts" not in told
    assert "boundary" not in told


def test_comparisons_that_cannot_be_are_said_before_the_freeze(three, owner):
    named = Checkpoint.objects.get(name=BETTER)
    for changed, words in (
        ({"comparing": "control"}, "no control is chosen"),
        (
            {"comparing": "all", "first": named},
            "comparisons of all checkpoints with each other name none by name",
        ),
        ({"comparing": "all", "margin": 0.1}, "margin with comparisons of all checkpoints"),
        ({"comparing": "all", "drop_arms": True}, "arms are dropped with the design 'none'"),
        ({"drop_arms": True}, "needs the comparison that it is about"),
        ({"comparing": "all", "allocation": "random"}, "3 checkpoints in random order; allowed: 2"),
    ):
        with transaction.atomic():
            with pytest.raises(EvaError, match=words):
                frozen_plan(three, owner, **changed)
            transaction.set_rollback(True)


def test_a_random_order_that_its_design_has_no_room_for_is_drawn_again(draft, owner, monkeypatch):
    keys = iter(bytes([n]) * 32 for n in range(1, 250))
    made = []

    def drawn(plan, key):
        made.append(key)
        if len(made) < 3:
            raise UnevenError(
                "in random order two checkpoints came to 251 and 247 trials; allowed: 1 to 250 of each"
            )
        return document_of(plan, key)

    monkeypatch.setattr(services, "new_key", lambda: next(keys))
    monkeypatch.setattr(services, "document_of", drawn)
    plan = frozen_plan(draft, owner, allocation="random", stopping="late", repetitions=5)
    assert bytes(plan.key) == bytes([3]) * 32
    monkeypatch.undo()
    counts = plan.document["stopping"]["counts"]
    assert sum(counts[-1]) == 20


@pytest.mark.exhaustive
def test_more_blocks_than_a_boundary_has_room_for_are_refused_in_random_order(draft, owner):
    with pytest.raises(
        EvaError, match=r"came to \d+ and \d+ trials; allowed: 1 to 250 of each: plan fewer of them"
    ):
        frozen_plan(draft, owner, allocation="random", stopping="late", repetitions=130)


def test_random_order_needs_enough_blocks_and_no_e_process(draft, owner):
    for changed, words in (
        ({"repetitions": 2}, "4 blocks of checkpoints in random order; allowed: 5 or more"),
        ({"stopping": "evidence"}, "two arms in random order; allowed with"),
    ):
        with transaction.atomic():
            with pytest.raises(EvaError, match=words):
                frozen_plan(draft, owner, allocation="random", **changed)
            transaction.set_rollback(True)
