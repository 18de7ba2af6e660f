"""The page of integrity: who looked, what was thrown away, how trials were handed out, delays, the headline then."""

from dataclasses import dataclass
from datetime import timedelta

import pytest
from django.contrib.admin.models import CHANGE, LogEntry
from django.db import connection
from django.test import Client
from django.test.utils import CaptureQueriesContext

from evaweb.plans.allocation import allocate_trial, release_slots
from evaweb.plans.blinding_rules import record_unblinding
from evaweb.plans.models import Achieved, CameraCheck, Plan, Reference
from evaweb.plans.services import amend_plan, close_plan, freeze_plan, reveal_plan
from evaweb.results.analysis.conduct import balance
from evaweb.results.presentation.integrity import delays_banner, integrity_document
from evaweb.stations.models import Station
from evaweb.trials import services, voids
from evaweb.trials.corrections import trial_failure
from evaweb.trials.models import Trial
from tests.evaweb.trials import builders

NEW, OLD = "pi0-new", "pi0-block"
ADDRESS = "/result/plans/blocks/1/integrity/"


@pytest.fixture
def make(bench, request):
    """Makes the next trial: `wait` [s] from hand-out to run by checkpoint."""

    def one(wait=None, success=None, user=bench.operator, station=bench.station, plan=None, **facts):
        trial = allocate_trial(user=user, station=station, plan=plan or request.getfixturevalue("plan")).trial
        builders.finished_trial(trial, 9.0, **facts)
        name = trial.checkpoint.name
        seconds = (wait or {}).get(name, 10 + trial.number % 2)
        begun = trial.handout.handed_at + timedelta(seconds=seconds)
        took = {"connect_s": 1.0, "warm_up_s": 2.0}
        Trial.objects.filter(pk=trial.pk).update(
            started_at=begun, ended_at=begun + timedelta(seconds=9), setup_took=took
        )
        trial.refresh_from_db()
        ok = name == NEW if success is None else success
        services.score_trial(user=user, trial=trial, milestones=bench.ticks(True, ok, ok))
        trial.refresh_from_db()
        return trial

    return one


def ways(plan):
    return {row["what"]: row for row in integrity_document(plan)["headline"]}


@pytest.mark.exhaustive
def test_delays_that_differ_have_a_banner_and_those_that_do_not_have_none(plan, make):
    for _ in range(16):
        make(wait={NEW: 300, OLD: 5})
    record = integrity_document(plan)
    rows = {row["what"]: row for row in record["delays"]["rows"]}
    waits = rows["from hand-out to run"]
    (test,) = waits["tests"]
    assert (test["pairs"], test["difference"], test["p"]) == (8, 295.0, pytest.approx(2 / 2**8))
    assert test["corrected"] == pytest.approx(record["delays"]["tested"] * 2 / 2**8)
    assert rows["set-up: connecting to the policy"]["tests"][0]["p"] == 1.0
    assert "from hand-out to run, by +295 s" in delays_banner(record)
    assert delays_banner(record).startswith(f"Delays of {NEW} and {OLD} differ: from")


@pytest.mark.exhaustive
def test_delays_alike_have_no_banner(plan, make):
    for _ in range(16):
        make()
    assert delays_banner(integrity_document(plan)) == ""


def test_latencies_of_runs_are_compared_and_nonsense_of_a_station_is_not_known(plan, make):
    for n in range(4):
        make(policy={"latency_ms": {"p50": 120.0 + n}} if n else {"latency_ms": "late"})
    found = {row["what"]: row for row in integrity_document(plan)["delays"]["rows"]}[
        "policy's latency, median of the run"
    ]
    assert sum(arm["n"] for arm in found["arms"]) == 3
    assert max(arm["longest"] for arm in found["arms"]) == pytest.approx(0.123)


def test_voids_have_who_asked_and_who_answered(bench, plan, make):
    second = builders.user("sam")
    asked, refused, alone = (
        make(),
        make(),
        allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial,
    )
    for trial, agree in ((asked, True), (refused, False)):
        voids.void_trial(user=bench.operator, trial=trial, reason="the plate had slipped")
        voids.answer_void(user=second, trial=trial, agree=agree, reason="it had not" if not agree else "")
    builders.finished_trial(alone, 9.0)
    voids.void_trial(user=bench.operator, trial=alone, reason="no light")
    rows = {row["trial_id"]: row for row in integrity_document(plan)["voids"]}
    assert (rows[asked.pk]["by_name"], rows[asked.pk]["answered_by_name"]) == ("ann", "sam")
    assert rows[asked.pk]["answer"] == "agreed"
    assert (rows[refused.pk]["answer"], rows[refused.pk]["answer_reason"]) == ("refused", "it had not")
    assert (rows[alone.pk]["answer"], rows[alone.pk]["reason"]) == ("", "no light")
    assert len(rows) == 3


def test_corrections_are_told_before_and_after_the_reveal(bench, plan, owner, make):
    first, second = make(success=True), make(success=False)
    services.score_trial(
        user=bench.operator, trial=first, milestones=bench.ticks(True, False, False), reason="it slipped off"
    )
    close_plan(user=owner, plan=plan, reason="enough")
    reveal_plan(user=owner, plan=plan)
    services.score_trial(
        user=bench.operator, trial=second, milestones=bench.ticks(True, True, True), reason="on the video"
    )
    plan.refresh_from_db()
    early, late = integrity_document(plan)["corrections"]
    assert (early["trial_id"], early["before"], early["success"], early["late"]) == (
        first.pk,
        True,
        False,
        False,
    )
    assert (late["trial_id"], late["before"], late["success"], late["late"]) == (second.pk, False, True, True)
    remarks = integrity_document(plan)["remarks"]
    assert "1 score corrected before the reveal" in remarks
    assert "1 score came after the reveal" in remarks


def test_categories_and_notes_that_are_corrected_after_the_reveal_change_no_score(bench, plan, owner, make):
    first, second = make(success=False), make(success=False)
    close_plan(user=owner, plan=plan, reason="enough")
    reveal_plan(user=owner, plan=plan)
    for trial in (first, second):
        trial_failure(user=bench.operator, trial=trial, failure="slid")
    ticks = bench.ticks(True, False, False)
    said = {"failure": "slid", "note": "to the left", "reason": "a word more"}
    services.score_trial(user=bench.operator, trial=first, milestones=ticks, **said)
    plan.refresh_from_db()
    record = integrity_document(plan)
    assert [(row["changed"], row["late"]) for row in record["corrections"]] == [
        ("category", True),
        ("category", True),
        ("note", True),
    ]
    assert "2 failure categories corrected after the reveal" in record["remarks"]
    assert not any("came after the reveal" in words for words in record["remarks"])
    assert [row["late"] for row in record["checkpoints"]] == [0, 0]
    # Milestones that come to the same points are another verdict.
    ticks = bench.ticks(False, True, False)
    services.score_trial(user=bench.operator, trial=first, milestones=ticks, reason="on the video")
    assert "1 score came after the reveal" in integrity_document(plan)["remarks"]


@dataclass
class _Tried:
    checkpoint: str
    operator: str
    counts: bool = True


@pytest.mark.parametrize(
    ("made", "uneven"),
    [
        ({("ann", "a"): 9, ("ann", "b"): 3}, 0.0),  # b was dropped
        ({("ann", "a"): 6, ("ann", "b"): 2, ("ben", "a"): 3, ("ben", "b"): 1}, 0.0),
        ({("ann", "a"): 6, ("ben", "b"): 2}, 1.5),
        ({}, 0.0),
    ],
)
def test_balance_is_that_of_operators_and_not_of_what_was_tried_more_often(made, uneven):
    runs = [_Tried(checkpoint, who) for (who, checkpoint), count in made.items() for _ in range(count)]
    assert balance(runs, "operator")["uneven"] == uneven


def test_looks_and_amendments_are_named(plan, owner, make):
    make()
    record_unblinding(plan, owner)
    close_plan(user=owner, plan=plan, reason="too dark")
    amend_plan(user=owner, plan=plan, reason="a brighter lamp")
    found = integrity_document(plan)
    assert [row["by_name"] for row in found["looks"]] == ["olga"]
    assert found["amendments"] == [{"version": 2, "amends": 1, "because": "a brighter lamp"}]
    assert found["amendments"] == integrity_document(Plan.objects.get(name="blocks", version=2))["amendments"]


def test_blocks_that_were_split_or_handed_out_of_turn_are_counted(bench, plan, make):
    other, sam = Station.objects.create(name="bench-2", robot="agilex_piper", boot="b"), builders.user("sam")
    make()
    release_slots(user=bench.operator, plan=plan, station=bench.station, reason="the arm broke")
    make(station=other, user=sam)
    found = integrity_document(plan)
    assert found["deviations"]["split_stations"] == found["deviations"]["split_operators"] == [0]
    assert found["deviations"]["order"] == found["deviations"]["out_of_turn"] == []
    assert "the arm broke" in found["deviations"]["given_back"][0]["text"]
    assert found["stations"]["uneven"] == 0.5  # each has one trial of one checkpoint, of two halves
    assert len(found["operators"]["rows"]) == 2
    assert "1 block carried out on more than one station" in integrity_document(plan)["remarks"]


def test_cameras_that_nobody_had_confirmed_are_told_by_the_trial(bench, plan, make):
    make()
    check = CameraCheck.objects.create(
        station=bench.station,
        boot="b",
        by=bench.operator,
        seen={"top": {"match": 0.9}, "side": {"match": None}},
    )
    after = make()
    found = integrity_document(plan)["cameras"]
    assert [(row["by_name"], row["cameras"], row["match"]) for row in found["checks"]] == [("ann", 2, 0.9)]
    assert len(found["unchecked"]) == 1
    assert after.handout.code not in found["unchecked"]
    assert check.at == found["checks"][0]["at"]


@pytest.mark.exhaustive
def test_what_the_headline_would_be_without_an_operator(bench, plan, make):
    sam = builders.user("sam")
    for n in range(16):
        make(user=sam if n >= 4 else bench.operator)
    found = ways(plan)
    assert found["as it was decided"]["sentence"].startswith(
        f"{NEW} succeeded more often than {OLD}: 8/8 against 0/8"
    )
    without = found["without operator ann"]
    assert (without["pairs"], without["same"]) == (6, True)
    assert without["sentence"].startswith(f"{NEW} succeeded more often than {OLD}: 6/6 against 0/6")
    gone = found["without operator sam"]
    assert (gone["pairs"], gone["same"]) == (2, False)
    assert found["without station bench-1"]["sentence"] == "No pair is left"
    assert found["without station bench-1"]["same"] is None
    assert "The headline would change: without operator sam" in integrity_document(plan)["remarks"]


def test_repetitions_and_benches_below_the_least_match_are_left_out(bench, plan, make):
    again = allocate_trial(user=bench.operator, station=bench.station, plan=plan).trial
    builders.finished_trial(again, 9.0)
    voids.void_trial(user=bench.operator, trial=again, reason="no light")
    trials = [make() for _ in range(16)]
    plan.document["match_gate"] = 0.8
    for trial, match in ((trials[2], 0.9), (trials[4], 0.5)):
        seen = {"camera": "top", "picture": "0" * 64, "by": bench.operator}
        Achieved.objects.create(trial=trial, match=match, override="the lamp", **seen)
    found = ways(plan)
    assert found["only first attempts"]["pairs"] == 7
    assert found["without trials whose bench matched less than 0.8"]["pairs"] == 7


def test_nothing_is_left_out_of_a_design_that_did_not_end(plan, owner, make):
    make()
    make()
    close_plan(user=owner, plan=plan, reason="enough")
    plan.refresh_from_db()
    assert not any(what.startswith("without") for what in ways(plan))
    assert "before the design ended" in ways(plan)["as it was decided"]["sentence"]


@pytest.mark.exhaustive
def test_the_page_and_the_program_have_it_once_the_plan_is_revealed_and_not_before(plan, owner, make, bench):
    for _ in range(16):
        make(wait={NEW: 300, OLD: 5})
    client = Client()
    client.force_login(bench.operator)
    page = client.get(ADDRESS).content.decode()
    assert "Sealed" in page
    assert NEW not in page
    assert client.get("/api/v1/plans/blocks/1/integrity").status_code == 403
    plan.refresh_from_db()
    reveal_plan(user=owner, plan=plan)
    page = client.get(ADDRESS).content.decode()
    for words in ("What the headline would be", "Delays of pi0-new and pi0-block differ", "Balanced"):
        assert words in page, words
    assert "Not balanced" not in page
    home = client.get("/result/plans/blocks/1/").content.decode()
    assert "Delays of pi0-new and pi0-block differ" in home
    assert f'href="{ADDRESS}"' in home
    told = client.get("/api/v1/plans/blocks/1/integrity").json()
    assert told["headline"][0]["what"] == "as it was decided"
    assert told["delays"]["differing"] == ["from hand-out to run"]


def test_it_asks_as_often_whatever_the_number_of_trials(plan, make):
    def asked():
        with CaptureQueriesContext(
            connection,
        ) as found:
            integrity_document(plan)
        return len(found)

    make()
    make()
    few = asked()
    for _ in range(10):
        make()
    assert asked() == few <= 20


def test_what_ran_below_the_least_match_is_told_by_its_worst_region_when_last_looked_at(bench, owner, make):
    drafted = Plan.objects.create(name="gated", title="Gated", owner=owner, match_gate=0.75)
    drafted.checkpoints.set([bench.checkpoint])
    drafted.positions.set(bench.scene.positions.all())
    plan = freeze_plan(user=owner, plan=drafted)
    for number in range(2):
        trial = make(plan=plan)
        references = [
            Reference.objects.create(
                station=trial.station, position=trial.position, camera="cam_high", picture=name, by=owner
            )
            for name in ("a" * 64, "b" * 64)
        ]
        looks = [(0.9, 0.1, references[0]), (0.99, 0.05, references[number])]
        for match, worst, reference in looks if number else looks[::-1]:
            Achieved.objects.create(
                trial=trial,
                camera="cam_high",
                picture="c" * 64,
                reference=reference,
                match=match,
                regions=[
                    {"name": "block", "match": worst if number else 0.9},
                    {"name": "cup", "match": 0.95},
                ],
                override="the block is lost" if number else "",
                by=owner,
            )
    found = integrity_document(plan)
    (low,) = found["bench"]["low"]
    assert (low["code"], low["match"], low["override"]) == (
        trial.handout.code,
        0.05,
        "the block is lost",
    )
    assert [(row["camera"], row["used"]) for row in found["bench"]["references"]] == [("cam_high", 2)]
    assert (
        f"Run although the bench matched less than 0.75, for a reason: {trial.checkpoint.name} 1"
        in found["remarks"]
    )
    assert any("had 2 references at block-on-plate, position" in line for line in found["remarks"])


def test_without_a_least_match_no_trial_is_told_to_be_below_it(plan, make):
    make()
    assert integrity_document(plan)["bench"] == {"gate": None, "low": [], "unmatched": [], "references": []}


def test_scenes_and_checkpoints_that_were_edited_meanwhile_are_told_also_where_it_was_taken_back(
    plan, bench, owner, carry_out
):
    def edited(row, text):
        LogEntry.objects.log_actions(owner.pk, [row], CHANGE, text, single_object=True)

    carry_out(plan, 2)
    edited(bench.scene, "criterion")
    edited(bench.scene, "taken back")
    edited(bench.checkpoint, "policy")
    record = integrity_document(plan)
    assert [(row["what"], row["by_name"], row["text"]) for row in record["edits"]] == [
        ("scene block-on-plate", "olga", "criterion"),
        ("scene block-on-plate", "olga", "taken back"),
        ("checkpoint pi0-block", "olga", "policy"),
    ]
    said = "Edited after the plan was frozen, taken back or not: checkpoint pi0-block (1), scene block-on-plate (2)"
    assert said in record["remarks"]
