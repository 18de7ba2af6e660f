"""What an adversary steered: each is refused, or stands in the record."""

import pytest
from django.template.loader import render_to_string
from django.test import Client

from evaweb.blinding.visibility import visibility_for_user
from evaweb.core.errors import Conflict
from evaweb.plans.allocation import allocate_trial
from evaweb.plans.blinding_rules import record_unblinding
from evaweb.plans.counting import ended_by
from evaweb.plans.models import CountsAs, Plan
from evaweb.plans.selectors import overlapping_plans
from evaweb.plans.services import amend_plan, close_plan, freeze_plan, reveal_plan
from evaweb.preflights.services import start_preflight
from evaweb.results.presentation.integrity import integrity_document
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.results.reports.checklist import checklist
from evaweb.results.reports.reporting import report_context
from evaweb.stations.models import Station
from evaweb.trials import services, voids
from evaweb.trials.models import Checkpoint, Trial
from evaweb.trials.station_commands import _require_prepared
from evaweb.trials.voids import needs_two_people
from tests.evaweb.trials import builders
from tests.evaweb.unguarded import without_triggers

WORSE = "pi0-block"


@pytest.fixture
def plan(draft, owner):
    return freeze_plan(user=owner, plan=draft)


def handed(bench, plan):
    return allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial


def score(bench, trial, success, **said):
    return services.score_trial(
        user=bench.operator, trial=trial, milestones=bench.ticks(True, success, success), **said
    )


def ended(bench, plan, by="", frames=375):
    """The next trial, as a run leaves it that this ended."""
    trial = builders.finished_trial(handed(bench, plan), 9.0, frames=frames)
    status = "interrupted" if by in ("estop", "interruption") else "ended"
    reason = "e-stop by ann: make safe, then release" if by == "estop" else ""
    Trial.objects.filter(pk=trial.pk).update(status=status, ended_by=by, reason=reason)
    return Trial.objects.get(pk=trial.pk)


def practices(plan):
    return {item.practice: item for item in checklist(PlanResult(plan))}


@pytest.mark.parametrize("change", [{"active": False}, {"description": "another"}])
@pytest.mark.parametrize("name", [WORSE, "pi0-new"])
def test_a_checkpoint_that_is_changed_stops_the_trials_of_every_one_alike(bench, plan, name, change):
    trial = handed(bench, plan)
    builders.finished_trial(trial)
    score(bench, trial, True)
    prepared = handed(bench, plan)
    Checkpoint.objects.filter(name=name).update(**change)
    said = "switched off" if "active" in change else "was changed since"
    with pytest.raises(Conflict, match=f"a checkpoint .*{said}"):
        _require_prepared(prepared, "run", bench.operator)
    services.abandon_trial(user=bench.operator, trial=prepared)
    with pytest.raises(Conflict, match=f"a checkpoint .*{said}"):
        handed(bench, plan)


def test_while_a_blind_trial_is_under_way_no_preflight_is_asked_whichever_server_it_has(bench, plan):
    boss = builders.user("boss", "admin")
    other = Station.objects.create(name="bench-2", robot="agilex_piper", simulated=True, boot="b")
    handed(bench, plan)
    for url in ("ws://127.0.0.1:8000", "ws://127.0.0.1:8001", "ws://127.0.0.1:9"):
        asked = Checkpoint.objects.create(name=url[-4:], policy={"url": url})
        for user in (boss, bench.operator):
            with pytest.raises(Conflict, match="bench-1: a blind trial is under way there"):
                start_preflight(user=user, checkpoint=asked, station=other)


def test_who_looked_at_an_earlier_version_stands_in_the_record_of_the_next(bench, plan, owner):
    record_unblinding(plan, owner)
    second = freeze_plan(user=owner, plan=amend_plan(user=owner, plan=plan, reason="more trials"))
    record = integrity_document(second)
    (row,) = record["looks"]
    assert (row["by_name"], row["version"], row["own"], row["before"]) == ("olga", 1, False, True)
    assert "olga looked behind the blind of blocks v1 before this version was frozen" in record["remarks"]
    blind = practices(second)["Operators blind"]
    assert (blind.kept, "olga (at blocks v1)" in blind.record) == ("partly", True)


def test_trials_of_an_earlier_version_are_said_to_be_left_out(bench, plan, owner):
    score(bench, ended(bench, plan), True)
    second = freeze_plan(user=owner, plan=amend_plan(user=owner, plan=plan, reason="more trials"))
    one = practices(second)["One version of the plan"]
    assert (one.kept, one.record) == (
        "no",
        "version 2; 1 frozen before it, each with all of its alpha; their 1 attempts are not in these data",
    )
    assert "in this version" in practices(second)["No trial of this version voided after the reveal"].record


def test_failures_by_the_plan_stand_in_the_record_with_who_pressed(bench, draft, owner):
    Plan.objects.filter(pk=draft.pk).update(on_estop=CountsAs.FAILURE)
    plan = freeze_plan(user=owner, plan=Plan.objects.get())
    for _ in range(12):
        trial = handed(bench, plan)
        services.abandon_trial(user=bench.operator, trial=trial)
        trial = ended(bench, plan, "estop" if trial.checkpoint.name == "pi0-new" else "")
        score(bench, trial, True)
    plan.refresh_from_db()
    reveal_plan(user=owner, plan=plan)
    record = integrity_document(plan)
    assert "Runs ended by the e-stop: pi0-block 0 of 12, pi0-new 6 of 12" in record["remarks"]
    assert "Failures by the plan, whatever was reached: pi0-block 0 of 6, pi0-new 6 of 6" in record["remarks"]
    pressed = [row for row in record["broken_off"] if row["ended"] == "estop"]
    assert {(row["counts"], row["reason"].partition(":")[0]) for row in pressed} == {(True, "e-stop by ann")}
    ways = {way["what"]: way for way in record["headline"]}
    assert ways["without failures by the plan's declaration"]["sentence"] == "No pair is left"
    page = render_to_string("results/report.html", report_context(PlanResult(plan)))
    assert page.count("<td>By the plan: ended by the e-stop") == 6
    assert "6 trials are failures by the plan, because of what ended the run" in page
    shown = Client()
    shown.force_login(owner)
    listed = shown.get("/result/plans/blocks/1/trials/").content.decode()
    assert listed.count("<strong>By the plan: ended by the e-stop") == 6
    assert "6 trials are failures by the plan" in shown.get("/result/plans/blocks/1/").content.decode()
    one = shown.get(f"/result/trials/{pressed[0]['trial_id']}/").content.decode()
    assert "Ended by the e-stop: a failure by the plan, whatever was reached.</p>" in one


def test_a_failure_by_the_plan_is_voided_by_two_also_where_all_is_open(bench, draft, owner):
    Plan.objects.filter(pk=draft.pk).update(on_estop=CountsAs.FAILURE, blind=False)
    plan = freeze_plan(user=owner, plan=Plan.objects.get())
    declared, other = ended(bench, plan, "estop"), None
    score(bench, declared, True)
    other = ended(bench, plan)
    score(bench, other, True)
    assert [needs_two_people(Trial.objects.get(pk=trial.pk)) for trial in (declared, other)] == [True, False]


def test_what_ended_a_run_stays_whatever_becomes_of_its_recording(bench, plan):
    for by in ("estop", "timeout", ""):
        trial = ended(bench, plan, by)
        for status in ("finished", "failed"):
            type(trial.episode).objects.filter(pk=trial.episode_id).update(status=status)
            assert ended_by(Trial.objects.get(pk=trial.pk)) == (f"on_{by}" if by else "")
        score(bench, trial, True)


def test_while_a_void_waits_an_ask_that_found_a_boundary_crossed_stays_answered(bench, draft, owner):
    Plan.objects.filter(pk=draft.pk).update(stopping="early", repetitions=10)
    plan = freeze_plan(user=owner, plan=Plan.objects.get())
    done = []
    while not plan.events.filter(what="crossed").exists():
        try:
            trial = builders.finished_trial(handed(bench, plan))
        except Conflict:
            break
        score(bench, trial, trial.checkpoint.name == "pi0-new")
        done.append(trial)
        if len(done) == 1:
            voids.void_trial(user=bench.operator, trial=Trial.objects.get(pk=trial.pk), reason="it slipped")
    assert plan.events.filter(what="crossed").count() == 1
    one = done[-1]
    for success in (True, False):
        score(bench, Trial.objects.get(pk=one.pk), success, reason="the wrong key")
        with pytest.raises(Conflict, match="closed once the void of trial"):
            handed(bench, plan)
    voids.answer_void(user=builders.user("sam"), trial=done[0], agree=True)


def test_copies_of_checkpoints_make_a_plan_of_the_same(bench, plan, owner):
    def copied(name, *, of, **changed):
        row = Checkpoint.objects.get(name=of)
        given = {"digest": row.digest, "policy": row.policy, "strategy": row.strategy} | changed
        return Checkpoint.objects.create(name=name, **given)

    def frozen(name, *arms):
        made = Plan.objects.create(name=name, title=name, question="And now?", owner=owner, repetitions=1)
        made.checkpoints.set(arms)
        made.positions.set(bench.scene.positions.all())
        return freeze_plan(user=owner, plan=made)

    elsewhere = {"url": "ws://elsewhere:1"}
    with without_triggers("trials"):
        Checkpoint.objects.filter(name=WORSE).update(digest="d" * 64)
    weights = copied("a2", of=WORSE, policy=elsewhere)
    frozen("again", weights, copied("b2", of="pi0-new"))
    frozen("of one alone", weights, copied("c2", of=WORSE))
    assert [row.name for row in overlapping_plans(plan)] == ["again"]


def test_a_plan_without_a_comparison_keeps_what_counts_at_its_reveal(bench, draft, owner):
    Plan.objects.filter(pk=draft.pk).update(first=None, second=None)
    plan = freeze_plan(user=owner, plan=Plan.objects.get())
    for success in (True, False):
        score(bench, builders.finished_trial(handed(bench, plan)), success)
    close_plan(user=owner, plan=plan, reason="enough")
    reveal_plan(user=owner, plan=plan)
    plan.refresh_from_db()
    assert sum(row["n"] for row in plan.at_reveal["arms"]) == 2
    assert {"record", "measured", "judged", "conduct", "setting", "digest"} <= plan.at_reveal.keys()
    assert visibility_for_user(bench.operator).hides_nothing


def test_a_first_score_after_the_reveal_makes_no_doubt_about_before(bench, plan, owner):
    for _ in range(3):
        score(bench, builders.finished_trial(handed(bench, plan)), True)
    late = ended(bench, plan, "interruption")
    close_plan(user=owner, plan=plan, reason="enough")
    reveal_plan(user=owner, plan=plan)
    before = PlanResult(Plan.objects.get()).headline.caveats
    score(bench, late, True)
    assert PlanResult(Plan.objects.get()).headline.caveats == before


def test_the_name_of_an_account_stays(bench):
    browser = Client()
    browser.force_login(builders.user("root", "admin"))
    address = f"/admin/auth/user/{bench.operator.pk}/change/"
    browser.post(address, {"username": "other", "role": "operator", "is_active": "on"})
    bench.operator.refresh_from_db()
    assert bench.operator.username == "ann"
