import csv
import io
from uuid import uuid4

import pytest

from evaweb.plans.models import Plan
from evaweb.plans.services import freeze_plan
from evaweb.trials import services
from evaweb.trials.models import Checkpoint, Trial
from tests.evaweb.trials import builders


def prepare(rest, **given):
    choice = {"scene": "block-on-plate", "position": 1, "checkpoint": "pi0-block", **given}
    return rest.post("stations/bench-1/trials", **choice)


def ticks(bench, *reached):
    return {str(key): done for key, done in bench.ticks(*reached).items()}


def test_a_trial_is_prepared_scored_corrected_and_voided(rest, bench):
    status, made = prepare(rest)
    assert (status, made["status"], made["number"], made["evaluation"]) == (
        201,
        "prepared",
        1,
        "open bench bench-1",
    )
    builders.finished_trial(Trial.objects.get())
    where = f"trials/{made['id']}"
    status, scored = rest.post(f"{where}/score", milestones=ticks(bench, True, True, True), note="clean")
    assert (status, scored["success"], scored["score"], scored["note"]) == (200, True, 1.0, "clean")
    status, refused = rest.post(f"{where}/score", milestones=ticks(bench, True, True, False))
    assert status == 400
    assert "give a reason" in refused["error"]
    status, again = rest.post(
        f"{where}/score", milestones=ticks(bench, True, True, False), reason="it rolled off"
    )
    assert (status, again["success"], len(again["scores"])) == (200, False, 2)
    assert [m["reached"] for m in again["scores"][0]["milestones"]] == [True, True, False]
    status, void = rest.post(f"{where}/void", reason="the wrong plate")
    assert (status, void["status"], void["voided_by"]) == (200, "voided", "ann")
    assert rest.get(where) == (200, void)


def test_a_trial_that_never_ran_is_given_up(rest):
    _, made = prepare(rest)
    status, given_up = rest.post(f"trials/{made['id']}/abandon", reason="wrong one")
    assert (status, given_up["status"]) == (200, "abandoned")
    assert prepare(rest)[1]["attempt"] == 2


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"scene": "nope"}, "scene 'nope' does not exist; there are: block-on-plate"),
        ({"scene": 999}, "scene '999' does not exist"),
        ({"checkpoint": "nope"}, "checkpoint 'nope' does not exist; there are: pi0-block"),
        ({"position": 7}, "position 7 of scene block-on-plate does not exist; there are: 1, 2"),
        ({"position": 2**70}, "does not exist"),
    ],
)
def test_unknown_choices_are_not_found_and_named(rest, given, sentence):
    status, body = prepare(rest, **given)
    assert status == 404
    assert sentence in body["error"]
    assert not Trial.objects.exists()


def test_an_unknown_station_is_not_found(rest):
    status, body = rest.post(
        "stations/nope/trials", scene="block-on-plate", position=1, checkpoint="pi0-block"
    )
    assert status == 404
    assert "there are: bench-1" in body["error"]


def test_what_is_switched_off_is_refused(rest):
    Checkpoint.objects.update(active=False)
    status, body = prepare(rest)
    assert status == 409
    assert "switched off" in body["error"]


def test_a_second_trial_is_refused_with_what_to_do(rest):
    prepare(rest)
    status, body = prepare(rest, position=2)
    assert status == 409
    assert "abandon it, then prepare the next one" in body["error"]


def test_a_running_trial_is_not_scored(rest, bench):
    _, made = prepare(rest)
    Trial.objects.update(status="running")
    status, body = rest.post(f"trials/{made['id']}/score", milestones=ticks(bench, True, True, True))
    assert status == 409
    assert "is running and cannot be scored: stop it first" in body["error"]


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ({"milestones": {"": True}}, 400),
        ({"milestones": {"999": True}}, 400),
        ({"milestones": {}}, 400),
        ({"milestones": {"1": "perhaps"}}, 422),
        ({"milestones": {"1": "yes"}}, 422),
        ({"milestones": {"1": 1}}, 422),
        ({"milestones": [1]}, 422),
        ({"success": "perhaps"}, 422),
        ({"success": "true"}, 422),
    ],
)
def test_scores_that_make_no_sense_are_refused(rest, body, status):
    _, made = prepare(rest)
    builders.finished_trial(Trial.objects.get())
    got, answer = rest.post(f"trials/{made['id']}/score", **body)
    assert got == status
    assert answer["error"]
    assert Trial.objects.get().status == "ended"


@pytest.mark.parametrize("agree", ["yes", "true", "no", 1, 0, None])
def test_whoever_answers_a_void_says_true_or_false_and_nothing_like_it(rest, bench, agree):
    trial = bench.scored()
    status, answer = rest.post(f"trials/{trial.pk}/void/answer", agree=agree)
    assert status == 422
    assert "agree" in answer["error"]


def test_a_viewer_prepares_and_scores_nothing(viewer, bench):
    assert prepare(viewer)[0] == 403
    trial = bench.ended()
    for act in ("score", "void", "abandon"):
        status, body = viewer.post(f"trials/{trial.pk}/{act}")
        assert status == 403
        assert "vic is a viewer" in body["error"]


@pytest.mark.parametrize("id", [0, 999999, 2**63, 2**80])
def test_guessed_ids_are_not_found(rest, id):
    for path in (f"trials/{id}", f"trials/{id}/score"):
        ask = rest.post if path.endswith("score") else rest.get
        status, body = ask(path)
        assert (status, body["error"]) == (404, f"trial {id} does not exist")


def test_the_list_is_paged_and_filtered(rest, bench):
    other = Checkpoint.objects.create(name="other")
    for _ in range(3):
        bench.scored()
    bench.scored(False, checkpoint=other)
    status, page = rest.get("trials", limit=2, offset=1, status="scored")
    assert (status, page["total"], page["limit"], page["offset"], len(page["items"])) == (200, 4, 2, 1, 2)
    assert rest.get("trials", checkpoint="other")[1]["items"][0]["success"] is False
    assert rest.get("trials", since="2100-01-01")[1]["items"] == []
    assert rest.get("trials", scene="nope")[0] == 404
    assert rest.get("trials", status="nope")[0] == 400


def test_a_note_with_unicode_and_newlines_survives_to_csv(rest, bench):
    note = '=HYPERLINK("x")\nzweite Zeile, "好" — 🤖'
    trial = bench.ended()
    services.score_trial(
        user=bench.operator,
        trial=trial,
        milestones=bench.ticks(True, True, False),
        note=note,
        failure="-slip",
    )
    (row,) = csv.DictReader(io.StringIO(rest.csv("trials"), newline=""))
    assert row["note"] == f"'{note}"
    assert row["failure"] == "'-slip"
    assert (row["success"], row["score"], row["duration_s"]) == ("false", "0.5", "12.5")
    assert (row["milestones_reached"], row["milestones_missed"]) == ("held; lifted", "on the plate")


def test_a_failure_is_scored_in_the_labs_words_which_are_listed(rest, bench):
    builders.failure_terms()
    words = [(row["level"], row["words"], row["key"]) for row in rest.get("failures")[1]]
    assert words == [
        *(("phase", "approach", "a"), ("phase", "grasp", "g")),
        *(("cause", "missed", "m"), ("cause", "dropped", "d")),
    ]
    assert len(rest.get("failures", inactive="true")[1]) == 6
    trial = bench.ended()
    said = {"milestones": bench.ticks(True, False, False), "failure_phase": "grip", "failure": "dropped"}
    status, answer = rest.post(f"trials/{trial.pk}/score", **said)
    assert (status, answer["error"]) == (400, "failure_phase = 'grip'; allowed: approach, grasp")
    status, answer = rest.post(f"trials/{trial.pk}/score", **{**said, "failure_phase": "grasp"})
    assert status == 200
    assert (answer["failure_phase"], answer["scores"][0]["failure_phase"]) == ("grasp", "grasp")
    (row,) = csv.DictReader(io.StringIO(rest.csv("trials"), newline=""))
    assert (row["failure_phase"], row["failure"]) == ("grasp", "dropped")


def test_a_failure_is_corrected_alone_and_not_over_a_score_that_was_not_seen(rest, bench):
    builders.failure_terms()
    trial = bench.scored(False)
    seen = str(trial.verdict.uuid)
    status, answer = rest.post(f"trials/{trial.pk}/failure", failure="dropped", score=seen)
    assert (status, answer["failure_phase"], answer["failure"]) == (200, "", "dropped")
    assert answer["scores"][0]["reason"] == "failure was not specified, now dropped"
    assert [row["milestones"] for row in answer["scores"]] == [answer["scores"][0]["milestones"]] * 2
    status, answer = rest.post(f"trials/{trial.pk}/failure", failure_phase="grasp", score=seen)
    assert (status, "scored anew" in answer["error"]) == (409, True)


def test_csv_has_the_columns_of_json_and_all_rows(rest, bench):
    for _ in range(3):
        bench.scored()
    rows = list(csv.DictReader(io.StringIO(rest.csv("trials", status="scored", limit=1))))
    assert len(rows) == 3
    assert set(rest.get("trials")[1]["items"][0]) <= set(rows[0])


def test_statistics_say_n_and_interval_and_nothing_on_zero_trials(rest, bench):
    assert rest.get("statistics")[1]["items"] == []
    assert rest.csv("statistics").count("\r\n") == 1
    bench.ended()
    (row,) = rest.get("statistics")[1]["items"]
    assert (row["n"], row["rate"], row["low"], row["mean_score"], row["to_score"]) == (0, None, None, None, 1)
    Trial.objects.all().update(status="voided")
    bench.scored()
    (row,) = rest.get("statistics", scene="block-on-plate")[1]["items"]
    assert (row["n"], row["successes"], row["rate"], row["high"]) == (1, 1, 1.0, 1.0)
    assert row["low"] == pytest.approx(0.2065, abs=1e-4)
    (line,) = csv.DictReader(io.StringIO(rest.csv("statistics")))
    assert (line["n"], line["rate"], line["voided"]) == ("1", "1.0", "1")


def test_scenes_and_checkpoints_are_listed_and_inactive_ones_on_request(rest, bench):
    builders.scene("old-scene")
    type(bench.scene).objects.filter(name="old-scene").update(active=False)
    assert [row["name"] for row in rest.get("scenes")[1]["items"]] == ["block-on-plate"]
    assert rest.get("scenes", inactive="true")[1]["total"] == 2
    found = rest.get("scenes/block-on-plate")[1]
    assert [m["text"] for m in found["milestones"]] == ["held", "lifted", "on the plate"]
    assert found["positions"][0]["bench"] == {"block": [0.1, 0.3, 0], "plate": [-0.1, 0.3]}
    Checkpoint.objects.create(name="lab/pi0/step 5000")
    assert rest.get("checkpoints/lab/pi0/step 5000")[1]["name"] == "lab/pi0/step 5000"
    assert "policy" not in rest.get("checkpoints/pi0-block")[1]


def test_a_checkpoint_says_its_weights_its_lineage_and_its_tags_and_is_found_by_a_tag(rest, bench):
    old = Checkpoint.objects.create(name="base", tags=["v1"])
    Checkpoint.objects.create(name="tuned", parent=old, digest="sha256:0123abcd", tags=["v10", "block"])
    found = rest.get("checkpoints/tuned")[1]
    assert (found["parent"], found["digest"], found["tags"]) == ("base", "sha256:0123abcd", ["v10", "block"])
    assert rest.get("checkpoints/base")[1]["parent"] is None
    assert [row["name"] for row in rest.get("checkpoints", tag="v1")[1]["items"]] == ["base"]
    assert rest.get("checkpoints", tag="%")[1]["total"] == 0


def test_a_parent_of_a_blind_plan_is_not_named(rest, bench):
    hidden = Checkpoint.objects.create(name="of-the-plan")
    Checkpoint.objects.create(name="tuned", parent=hidden)
    owner = builders.user("olga")
    plan = Plan.objects.create(name="blind", title="Blind", owner=owner, blind=True)
    plan.checkpoints.set([hidden])
    plan.positions.set(bench.scene.positions.all())
    freeze_plan(user=owner, plan=plan)
    assert rest.get("checkpoints/tuned")[1]["parent"] is None


def test_a_score_whose_answer_was_lost_is_sent_again_and_there_is_one(rest, bench):
    trial, uuid = bench.ended(), str(uuid4())
    said = {"milestones": ticks(bench, True, True, True), "uuid": uuid}
    for _ in range(2):
        status, scored = rest.post(f"trials/{trial.pk}/score", **said)
        assert (status, [one["uuid"] for one in scored["scores"]]) == (200, [uuid])
    status, refused = rest.post(f"trials/{trial.pk}/score", **said, note="another one")
    assert (status, f"uuid {uuid} is that of another score" in refused["error"]) == (409, True)
    assert rest.post(f"trials/{trial.pk}/score", **{**said, "uuid": "seven"})[0] == 422
