"""What a run that did not end by itself counts as is the plan's to say, and nobody's afterwards."""

from __future__ import annotations

import pytest

from evaweb.core.errors import Conflict
from evaweb.core.tabular_export import plain
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.draft_checks import problems
from evaweb.plans.models import CountsAs, Plan
from evaweb.plans.services import amend_plan, close_plan, freeze_plan
from evaweb.plans.toml_exchange import export_toml, import_file
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.results.reports.recompute.scenes import ending_faults, scene_faults
from evaweb.results.reports.tables import outcome_pages, score_pages
from evaweb.trials import services, voids
from evaweb.trials.models import Trial
from tests.evaweb.trials import builders

ESTOP, FAULT, TIME = "the e-stop was pressed by ann", "the policy server was lost", "the run's 60 s are over"


@pytest.fixture
def declared(draft, owner):
    """A frozen plan with that declared."""

    def declare(**counts):
        Plan.objects.filter(pk=draft.pk).update(**counts)
        return freeze_plan(user=owner, plan=Plan.objects.get(pk=draft.pk))

    return declare


def ended(bench, plan, reason, status="interrupted"):
    """The next trial, as a run leaves it that ended so."""
    trial = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    builders.finished_trial(trial, 10.0, status="finished" if status == "ended" else "interrupted")
    Trial.objects.filter(pk=trial.pk).update(status=status, reason=reason)
    return Trial.objects.get(pk=trial.pk)


def scored(bench, trial, reached, **said):
    ticks = bench.ticks(True, reached, reached)
    return services.score_trial(user=bench.operator, trial=trial, milestones=ticks, **said)


@pytest.mark.parametrize(
    ("name", "reason", "status"),
    [
        ("on_estop", ESTOP, "interrupted"),
        ("on_interruption", FAULT, "interrupted"),
        ("on_timeout", TIME, "ended"),
    ],
)
def test_what_is_a_failure_by_the_plan_is_scored_as_one_and_stays_one(bench, declared, name, reason, status):
    plan = declared(**{name: CountsAs.FAILURE})
    trial = ended(bench, plan, reason, status)
    with pytest.raises(Conflict, match="by Blocks v1 that is a failure, whatever was reached"):
        scored(bench, trial, True, success=True)
    if status == "interrupted":
        with pytest.raises(Conflict, match="score it before the next one"):
            allocate_trial(user=bench.operator, station=bench.station, plan=plan)
    assert "a failure by the plan, whatever was reached" in services.failing(trial)
    honest = scored(bench, trial, True)
    assert (honest.success, honest.score) == (False, 1.0)
    again = Trial.objects.get(pk=trial.pk)
    with pytest.raises(Conflict, match="that is a failure"):
        scored(bench, again, True, success=True, reason="it had it after all")
    assert allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial.attempt == 1


@pytest.mark.parametrize(("name", "reason"), [("on_estop", ESTOP), ("on_interruption", FAULT)])
def test_what_is_repeated_by_the_plan_is_not_scored(bench, declared, name, reason):
    plan = declared(**{name: CountsAs.REPEATED})
    trial = ended(bench, plan, reason)
    for success in (True, False):
        with pytest.raises(Conflict, match="by Blocks v1 it is repeated, and not scored"):
            scored(bench, trial, success)
    assert allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial.attempt == 2


def test_what_the_plan_says_of_one_end_is_said_of_no_other(bench, declared):
    plan = declared(on_estop=CountsAs.REPEATED, on_timeout="failure")
    assert scored(bench, ended(bench, plan, FAULT), True).success is True
    assert scored(bench, ended(bench, plan, "stopped by the operator", "ended"), True).success is True


def test_it_is_frozen_amended_and_exported_with_the_plan(bench, declared, owner):
    plan = declared(on_estop=CountsAs.FAILURE)
    assert plan.document["counts_as"] == {
        "on_estop": "failure",
        "on_interruption": "judged",
        "on_timeout": "judged",
    }
    text = export_toml(plans=[plan])
    assert 'on_estop = "failure"' in text
    again = amend_plan(user=owner, plan=plan, reason="more")
    assert again.on_estop == "failure"
    Plan.objects.filter(pk=again.pk).update(on_estop="judged")
    import_file(user=builders.user("alma", "admin"), text=text)
    again.refresh_from_db()
    assert again.on_estop == "failure"


def test_exports_say_what_ended_each_run_and_the_reports_program_holds_it_against_the_plan(bench, declared):
    plan = declared(on_estop=CountsAs.REPEATED, on_timeout="failure")
    ended(bench, plan, ESTOP)
    scored(bench, ended(bench, plan, TIME, "ended"), True)
    scored(bench, ended(bench, plan, "stopped by the operator", "ended"), True)
    voids.void_trial(user=bench.operator, trial=ended(bench, plan, FAULT), reason="the e-stop box fell on it")
    (page,) = outcome_pages(PlanResult(plan))
    assert [row["ended_by"] for row in page] == ["estop", "timeout", "", ""]
    rows = [{name: plain(value) for name, value in row.items()} for row in page]
    assert ending_faults(plan.document, rows) == []
    scores = [
        {name: plain(value) for name, value in row.items()} for page in score_pages(plan) for row in page
    ]
    assert scene_faults(plan.document, rows, scores) == []
    judged = {**plan.document, "counts_as": {}}
    assert scene_faults(judged, rows, scores) == [
        f"trial {rows[1]['trial']}, judged by ann: success is False, its required milestones say True"
    ]
    rows[0]["status"] = "scored"
    rows[1]["success"] = "true"
    assert ending_faults(plan.document, rows) == [
        f"trial {rows[0]['trial']} counts, its end (estop) is repeated by the plan",
        f"trial {rows[1]['trial']} is a success, its end (timeout) is a failure by the plan",
    ]
    rows[0]["status"] = "interrupted"
    counts = {"on_estop": "failure", "on_timeout": "judged"}
    assert ending_faults({"counts_as": counts}, rows) == [
        f"trial {rows[0]['trial']} was repeated, its end (estop) is a failure by the plan"
    ]
    assert ending_faults({}, [{**row, "ended_by": ""} for row in rows]) == []


def test_what_is_a_failure_by_the_plan_is_not_voided_away_before_its_score(bench, declared):
    plan = declared(on_estop=CountsAs.FAILURE)
    trial = ended(bench, plan, ESTOP)
    with pytest.raises(Conflict, match="that is a failure; score it before the next one"):
        voids.void_trial(user=bench.operator, trial=trial, reason="the plate had slipped")
    scored(bench, trial, False)
    asked = voids.void_trial(
        user=bench.operator, trial=Trial.objects.get(pk=trial.pk), reason="it had slipped"
    )
    assert asked.status == "void_asked"


def test_a_plan_is_not_closed_before_its_failures_are_scored(bench, declared, owner):
    plan = declared(on_estop=CountsAs.FAILURE, on_interruption=CountsAs.REPEATED)
    trial = ended(bench, plan, ESTOP)
    with pytest.raises(Conflict, match=r"1 trials of Blocks v1 are not finished, .* is interrupted: score"):
        close_plan(user=owner, plan=plan, reason="enough")
    scored(bench, trial, False)
    ended(bench, plan, FAULT)
    assert close_plan(user=owner, plan=plan, reason="enough").state == "closed"


def test_what_left_no_row_is_repeated_whatever_the_plan_says(bench, declared):
    plan = declared(on_interruption=CountsAs.FAILURE)
    trial = ended(bench, plan, FAULT)
    Trial.objects.filter(pk=trial.pk).update(episode=None)
    assert allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial.attempt == 2


def test_a_failure_by_the_plan_keeps_no_partial_credit(draft):
    draft.outcome, draft.on_estop = "score", CountsAs.FAILURE
    (found,) = problems(draft)
    assert "the e-stop counts as a failure, which keeps its partial credit" in found.text
