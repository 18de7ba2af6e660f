"""Arms that are one checkpoint served in several ways, and anchors, which are compared with none."""

import pytest

from evaweb.core.errors import Conflict
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.design import planned
from evaweb.plans.draft_checks import problems
from evaweb.plans.frozen_document import document_of
from evaweb.plans.models import Plan
from evaweb.plans.services import close_plan, freeze_plan, reveal_plan
from evaweb.plans.toml_exchange import export_toml, import_file
from evaweb.results.analysis.drift import anchors_of
from evaweb.results.presentation.integrity import integrity_document
from evaweb.trials import services
from evaweb.trials.models import Checkpoint, Scene
from evaweb.trials.station_commands import setup_args
from tests.evaweb.trials import builders

RTC = {"kind": "rtc", "inference_rate": 5.0}


@pytest.fixture
def served(bench):
    """The weights of the bench's checkpoint, asked otherwise."""
    return Checkpoint.objects.create(name="pi0-rtc", policy=bench.checkpoint.policy, strategy=RTC)


@pytest.fixture
def anchor(db):
    return Checkpoint.objects.create(name="act-anchor", policy={}, anchor=True)


def strategies(bench, plan, count):
    """Strategy of each of the next trials, by checkpoint, as the station gets it."""
    found = {}
    for _ in range(count):
        trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
        found[trial.checkpoint.name] = setup_args(trial, trial.pk).get("strategy")
        builders.finished_trial(trial)
        services.score_trial(user=bench.operator, trial=trial, milestones=bench.ticks(True, True, True))
    return found


def test_each_trial_runs_with_the_strategy_of_its_checkpoint_else_of_its_plan(bench, draft, served, owner):
    draft.checkpoints.add(served)
    assert strategies(bench, freeze_plan(user=owner, plan=draft), 3) == {
        "pi0-block": None,
        "pi0-new": None,
        "pi0-rtc": RTC,
    }
    assert bench.prepare(checkpoint=served).strategy == RTC


def test_a_plan_has_one_strategy_for_all_or_leaves_it_to_its_checkpoints(draft, served, owner):
    draft.strategy = {"kind": "sync"}
    draft.save()
    assert list(problems(draft)) == []
    draft.checkpoints.add(served)
    (found,) = problems(draft)
    assert found.text == "the plan has a strategy for all trials, and one of their own have: pi0-rtc"


def test_a_strategy_of_before_it_was_checked_is_found_at_the_freeze(draft):
    Plan.objects.filter(pk=draft.pk).update(strategy={"kind": "asink"})
    (found,) = problems(Plan.objects.get(pk=draft.pk))
    assert (found.step, found.text) == (
        "design",
        "strategy: kind = 'asink'; allowed: ensemble, naive, async, rtc, sync",
    )


def test_a_strategy_is_frozen_and_exported_and_an_edit_needs_another_plan(
    bench, draft, served, anchor, owner
):
    draft.checkpoints.add(served, anchor)
    plan = freeze_plan(user=owner, plan=draft)
    told = {row["name"]: row for row in plan.document["checkpoints"]}
    assert (told["pi0-rtc"]["strategy"], told["act-anchor"]["anchor"]) == (RTC, True)
    assert {"strategy", "anchor"} & {*told["pi0-block"]} == set()
    text = export_toml(checkpoints=[served, anchor])
    admin = builders.user("adam", "admin")
    assert import_file(user=admin, text=text) == [
        "checkpoint act-anchor: the same",
        "checkpoint pi0-rtc: the same",
    ]
    with pytest.raises(Conflict, match="checkpoint pi0-rtc is in use"):
        import_file(user=admin, text=text.replace("5.0", "6.0"))
    Checkpoint.objects.filter(pk=served.pk).update(strategy=RTC | {"inference_rate": 6.0})
    with pytest.raises(Conflict, match="a checkpoint was changed since"):
        strategies(bench, plan, 12)


# --- anchors -----------------------------------------------------------------------------------------------


def test_an_anchor_is_tried_in_every_block_and_compared_where_it_is_named(draft, anchor):
    draft.checkpoints.add(anchor)
    assert planned(draft) == [("pi0-new", "pi0-block")]
    draft.first, draft.second, draft.comparing = None, None, "all"
    assert planned(draft) == [("pi0-block", "pi0-new")]
    document = document_of(draft, bytes(32))
    assert [row["name"] for row in document["checkpoints"]] == ["act-anchor", "pi0-block", "pi0-new"]
    draft.first, draft.comparing = anchor, "control"
    assert planned(draft) == [("pi0-block", "act-anchor"), ("pi0-new", "act-anchor")]


def test_all_with_each_other_are_two_beside_the_anchor(draft, anchor):
    draft.checkpoints.set([anchor, draft.first])
    draft.first, draft.second, draft.comparing = None, None, "all"
    (found,) = problems(draft)
    assert "need two checkpoints or more" in found.text


@pytest.fixture
def carried_out(bench, owner, anchor):
    """A plan of that name with the anchor and another checkpoint, carried out and revealed."""

    def carry(name, succeeds, repetitions=4, reveal=True):
        plan = Plan.objects.create(
            name=name, title=name.title(), question="?", owner=owner, repetitions=repetitions
        )
        plan.checkpoints.set([bench.checkpoint, anchor])
        plan.positions.set(bench.scene.positions.all())
        plan = freeze_plan(user=owner, plan=plan)
        tried = 0
        for _ in range(4 * repetitions):
            trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
            won = trial.checkpoint != anchor or succeeds(tried)
            tried += trial.checkpoint == anchor
            builders.finished_trial(trial)
            services.score_trial(user=bench.operator, trial=trial, milestones=bench.ticks(True, won, won))
        plan = close_plan(user=owner, plan=plan, reason="all are made")
        return reveal_plan(user=owner, plan=plan) if reveal else plan

    return carry


def test_an_anchor_tells_of_a_bench_that_drifted_since_earlier_plans(carried_out):
    carried_out("monday", lambda tried: True)
    carried_out("sealed", lambda tried: False, reveal=False)
    found = carried_out("tuesday", lambda tried: False)
    (told,) = anchors_of(found)
    assert [(row["plan"], row["successes"], row["n"]) for row in told["plans"]] == [
        ("monday", 8, 8),
        ("tuesday", 0, 8),
    ]
    # Each of two positions: 4 of 4 against 0 of 4, one way of 70 either way.
    assert told["against_earlier"] == pytest.approx(2 / 70**2)
    assert told["within"] is None
    (remark,) = (row for row in integrity_document(found)["remarks"] if row.startswith("Anchor"))
    assert remark.startswith("Anchor act-anchor did not succeed as often as in earlier plans (p < 0.001)")


def test_an_anchor_tells_of_a_bench_that_drifted_within_a_plan(carried_out):
    (told,) = anchors_of(carried_out("monday", lambda tried: tried < 8, repetitions=8))
    assert told["against_earlier"] is None
    assert told["within"] == pytest.approx(2 / 70**2)


def test_earlier_trials_of_another_scene_or_another_policy_are_not_the_same(carried_out, anchor):
    carried_out("monday", lambda tried: True)
    Scene.objects.update(criterion="upside down, too")
    (told,) = anchors_of(carried_out("tuesday", lambda tried: False))
    assert [row["plan"] for row in told["plans"]] == ["tuesday"]
    Checkpoint.objects.filter(pk=anchor.pk).update(policy={"url": "ws://127.0.0.1:9"}, description="moved")
    (told,) = anchors_of(carried_out("wednesday", lambda tried: False))
    assert [row["plan"] for row in told["plans"]] == ["wednesday"]
    Checkpoint.objects.filter(pk=anchor.pk).update(description="moved again")
    (told,) = anchors_of(carried_out("thursday", lambda tried: False))
    assert [row["plan"] for row in told["plans"]] == ["wednesday", "thursday"]
