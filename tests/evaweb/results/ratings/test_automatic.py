"""Automatic judges look at trials; what they say is kept beside the record, and changes nothing of it."""

import base64
import json

import pytest
from django.db import DatabaseError, transaction
from django.urls import reverse

from evaweb.core.canonical_json import digest
from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotAllowed,
    NotFound,
)
from evaweb.episodes.folders import preview_folder, scores_file
from evaweb.episodes.publishing import success_of
from evaweb.episodes.reconcile import reconcile
from evaweb.jobs.models import Job, JobStatus
from evaweb.jobs.services import cancel, retry_job, run_queue
from evaweb.plans.commitment import make_commitment
from evaweb.plans.frozen_document import scene_of, units_of
from evaweb.plans.models import Plan, PlanEvent
from evaweb.plans.services import reveal_plan
from evaweb.results import job_kinds
from evaweb.results.analysis import caching
from evaweb.results.analysis.agreement import judge_agreement, rater_agreement
from evaweb.results.models import AutomaticJudge, Judgement
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.results.ratings import automatic, rating_queue
from evaweb.results.ratings.footage import (
    CAMERAS,
    OF_EACH,
    sample,
    trial_stills,
)
from evaweb.results.reports.reporting import report_numbers
from evaweb.results.reports.tables import outcome_pages
from evaweb.trials import services
from evaweb.trials.models import Milestone, Scene, Score, Trial
from tests.evaweb.results.judges.server import http, message, said, serving
from tests.evaweb.trials import builders
from tests.evaweb.unguarded import without_triggers
from tests.runtime.cameras.movies import movie

SAID = said((1, "reached", 0.95), (2, "reached", 0.75), (3, "not reached", 0.2))


@pytest.fixture(autouse=True)
def _quiet(monkeypatch):
    monkeypatch.setattr("evaweb.jobs.doorbell.notify_workers", lambda queue: True)
    caching.clear_caches()


@pytest.fixture
def admin(db):
    return builders.user("alma", "admin")


@pytest.fixture(scope="module")
def filming(tmp_path_factory):
    made = tmp_path_factory.mktemp("filming") / "top.mp4"
    movie(made, pictures=12)
    return made.read_bytes()


@pytest.fixture
def filmed(plan, carry_out, filming):
    """A plan carried out and not revealed, of whose trials there are videos of one camera."""
    carry_out(plan, 16)
    for handout in plan.handouts.all():
        (preview_folder(handout.trial.episode_id) / "top.mp4").write_bytes(filming)
    return plan


def freeze_as_it_is(plan):
    """As if its scene had been like this when it was frozen."""
    scene = Scene.objects.get()
    document = {**plan.document, "scenes": [scene_of(scene, list(scene.positions.order_by("number")))]}
    changed = {"document": document, "digest": digest(document)}
    changed["commitment"] = make_commitment(changed["digest"], units_of(plan), bytes(plan.key))
    with without_triggers("plans"):
        Plan.objects.filter(pk=plan.pk).update(**changed)
    plan.refresh_from_db()


@pytest.fixture
def truth(filmed):
    """The bench of its trials knows of two milestones; of one trial it says the opposite of its score."""
    for order, name in ((1, "held"), (3, "on_plate")):
        Milestone.objects.filter(order=order).update(truth=name)
    freeze_as_it_is(filmed)
    for handout in filmed.handouts.select_related("trial__verdict"):
        reached = handout.trial.verdict.success != (handout.number == 1)
        told = {
            "success": reached,
            "milestones": {"held": True, "on_plate": reached},
            "reached": {"held": 2.0},
        }
        Trial.objects.filter(pk=handout.trial_id).update(truth=told)
    AutomaticJudge.objects.create(name="truth", kind="bench")
    return filmed


@pytest.fixture
def chat(admin):
    """Makes a chat judge at an address, allowed unless said otherwise."""

    def make(address, allowed=True, **setup):
        judge = AutomaticJudge(name="seer", kind="chat", address=address, model="seer-1", **setup)
        judge.full_clean()
        judge.save()
        if allowed:
            automatic.judge_allow(user=admin, judge=judge)
        return judge

    return make


def asked(plan, owner, name):
    automatic.request_judging(user=owner, plan=plan, name=name)
    run_queue("gpu")
    return Job.objects.filter(kind="judge").order_by("-pk").first()


def test_the_benchs_truth_is_held_against_the_scores(truth, owner):
    job = asked(truth, owner, "truth")
    assert (job.status, job.result) == (JobStatus.DONE, {"shown": 16, "left": 0, "without_pictures": []})
    (found,) = judge_agreement(truth)
    assert (found["judge"], found["version"], found["trials"], found["no_verdict"]) == (
        "truth",
        "bench 1",
        16,
        {},
    )
    held, lifted, plate = (found["milestones"][text] for text in ("held", "lifted", "on the plate"))
    assert (held["no_verdict"], held["agreement"]["same"], held["brier"]) == (0, 16, 0)
    assert (lifted["no_verdict"], lifted["agreement"], lifted["brier"]) == (16, None, None)
    assert (plate["agreement"]["n"], plate["agreement"]["same"], plate["brier"]) == (16, 15, 1 / 16)
    assert found["calibration"]["n"] == 32
    assert [row.pictures for row in Judgement.objects.all()] == [[]] * 16


def test_what_was_reached_too_late_the_bench_does_not_count(truth, owner):
    Milestone.objects.filter(truth="held").update(time_limit_s=1.5)
    freeze_as_it_is(truth)
    asked(truth, owner, "truth")
    assert {tuple(row.milestones[0]) for row in Judgement.objects.all()} == {("held", False, 0.0)}


def test_pictures_and_criteria_are_sent_and_nothing_that_tells_what_it_is_of(filmed, owner, chat, bench):
    Scene.objects.update(criterion="it rests on the plate")
    freeze_as_it_is(filmed)
    with serving(SAID) as server:
        chat(server.address)
        assert asked(filmed, owner, "seer").result["shown"] == 16
    assert len(server.heard) == 16
    sent = b"".join(head.encode() + body for head, body in server.heard).decode()
    trials = [handout.trial for handout in filmed.handouts.select_related("trial__episode")]
    forbidden = {
        *("pi0-new", "pi0-block", filmed.title, filmed.question, filmed.digest, filmed.commitment, "bench-1"),
        *(bench.operator.username + '"', "olga", "alma", "top", ".mp4", "dropped", "Exif", "ws://"),
        *(handout.code for handout in filmed.handouts.all()),
        *(str(value) for trial in trials for value in (trial.uuid, trial.episode_id)),
    }
    assert [word for word in forbidden if word in sent] == []
    assert "it rests on the plate" in sent
    content = json.loads(server.heard[0][1])["messages"][1]["content"]
    urls = [part["image_url"]["url"] for part in content if part["type"] == "image_url"]
    assert len(urls) == OF_EACH
    jpegs = [base64.b64decode(url.partition(",")[2]) for url in urls]
    assert not any(b"Exif" in jpeg or b"bench" in jpeg for jpeg in jpegs)


def test_what_it_said_is_kept_with_digests_of_what_it_was_asked(filmed, owner, chat):
    with serving(SAID) as server:
        chat(server.address)
        asked(filmed, owner, "seer")
    rows = list(Judgement.objects.all())
    assert len(rows) == 16
    for row in rows:
        assert row.milestones == [["held", True, 0.95], ["lifted", True, 0.75], ["on the plate", False, 0.2]]
        assert (row.judge, row.version, row.model) == ("seer", "chat 1, seer-1", "seer-2026-11-01")
        assert [len(digest) for _, _, digest in row.pictures] == [64] * OF_EACH
        assert [(camera, at) for camera, at, _ in row.pictures][::7] == [("camera 1", 0.0), ("camera 1", 1.1)]
    assert len({row.prompt for row in rows}) == 1
    with pytest.raises(DatabaseError, match="never changed"), transaction.atomic():
        Judgement.objects.update(judge="me")


@pytest.mark.some(1)
@pytest.mark.parametrize(
    ("play", "reason"),
    [
        (message(None, refusal="no\nrobots\x00" + "!" * 900), "it refused: no robots!"),
        (http(500, b""), "the server answered HTTP 500"),
        (said((1, "reached", 0.9)), "it spoke of the milestones [1]; asked were 1 to 3"),
    ],
)
def test_no_verdict_is_kept_with_its_reason_and_not_asked_again(filmed, owner, chat, play, reason):
    with serving(play) as server:
        chat(server.address)
        asked(filmed, owner, "seer")
        asked(filmed, owner, "seer")
        assert len(server.heard) == 16
    row = Judgement.objects.first()
    assert row.reason.startswith(reason)
    assert len(row.reason) <= automatic.LONGEST_REASON
    (found,) = judge_agreement(filmed)
    assert (list(found["no_verdict"].values()), found["calibration"]) == ([16], None)
    assert found["milestones"]["held"] == {"no_verdict": 16, "agreement": None, "brier": None}


def test_a_server_that_was_never_allowed_or_moved_since_is_not_spoken_to(filmed, owner, chat, admin):
    with serving(SAID) as server:
        judge = chat(server.address, allowed=False)
        with pytest.raises(NotAllowed, match=r"judge seer: .* is not allowed: an administrator allows it"):
            automatic.request_judging(user=owner, plan=filmed, name="seer")
        automatic.judge_allow(user=admin, judge=judge)
        assert (judge.allowed_by, judge.allowed_address) == (admin, server.address)
        with serving(SAID) as other:
            automatic.request_judging(user=owner, plan=filmed, name="seer")
            AutomaticJudge.objects.update(address=other.address)
            run_queue("gpu")
            assert other.heard == []
        AutomaticJudge.objects.update(address=server.address)
        automatic.judge_forbid(user=admin, judge=judge)
        Job.objects.update(not_before=None)
        run_queue("gpu")
        assert server.heard == []
    job = Job.objects.get(kind="judge")
    assert (job.attempts, "is not allowed" in job.error) == (2, True)
    assert Judgement.objects.count() == 0


def test_one_that_is_forbidden_meanwhile_is_asked_no_further(filmed, owner, chat, admin):
    with serving(SAID) as server:
        judge = chat(server.address)
        assert automatic.judge_next_trial(plan=filmed, name="seer")
        automatic.judge_forbid(user=admin, judge=judge)
        with pytest.raises(NotAllowed):
            automatic.judge_next_trial(plan=filmed, name="seer")
        assert (len(server.heard), Judgement.objects.count()) == (1, 1)


def test_who_may_allow_and_who_may_ask(truth, owner, admin, bench, chat):
    judge = chat("https://judge.example/v1", allowed=False)
    for act in (automatic.judge_allow, automatic.judge_forbid):
        with pytest.raises(NotAllowed, match="needs an admin"):
            act(user=owner, judge=judge)
    for user in (bench.operator, builders.user("vera", "viewer")):
        with pytest.raises(NotAllowed):
            automatic.request_judging(user=user, plan=truth, name="truth")
    with pytest.raises(NotFound, match="there is no judge 'none'; there are: seer, truth"):
        automatic.request_judging(user=owner, plan=truth, name="none")
    draft = Plan.objects.create(name="later", title="Later", owner=owner)
    with pytest.raises(Conflict, match="is a draft"):
        automatic.request_judging(user=owner, plan=draft, name="truth")
    with pytest.raises(Conflict, match="has no address"):
        automatic.judge_allow(user=admin, judge=AutomaticJudge.objects.get(name="truth"))
    assert Job.objects.filter(kind="judge").count() == 0
    for user in (owner, admin):
        automatic.request_judging(user=user, plan=truth, name="truth")
    assert Job.objects.filter(kind="judge").count() == 1
    events = PlanEvent.objects.filter(plan=truth, what="judge asked")
    assert [event.by for event in events] == [owner, admin]
    assert [one.name for one in automatic.judges_ready()] == ["truth"]


def test_who_may_not_ask_a_judge_does_not_repeat_what_was_asked(truth, owner, admin, bench):
    job = automatic.request_judging(user=owner, plan=truth, name="truth")
    cancel(user=owner, job=job)
    with pytest.raises(NotAllowed, match="this needs an admin"):
        retry_job(user=bench.operator, job=job)
    assert retry_job(user=admin, job=job).status == JobStatus.QUEUED


@pytest.mark.exhaustive
def test_each_trial_is_shown_to_a_version_once_however_often_it_is_asked_or_dies(
    filmed, owner, chat, monkeypatch
):
    monkeypatch.setattr(job_kinds, "_TURN_S", 0.0)  # one trial, then whatever else waits
    with serving(SAID) as server:
        chat(server.address)
        automatic.judge_next_trial(plan=filmed, name="seer")  # as a worker that was killed after it
        asked(filmed, owner, "seer")
        asked(filmed, owner, "seer")
        assert (len(server.heard), Judgement.objects.count()) == (16, 16)
        assert Job.objects.filter(kind="judge", status=JobStatus.DONE, result__shown=1).count() == 15
        AutomaticJudge.objects.update(model="seer-2")
        asked(filmed, owner, "seer")
        assert (len(server.heard), Judgement.objects.count()) == (32, 32)
    assert [(one["version"], one["trials"]) for one in judge_agreement(filmed)] == [
        ("chat 1, seer-1", 16),
        ("chat 1, seer-2", 16),
    ]


def test_a_judge_that_fails_itself_keeps_nothing_and_is_named_by_the_job(filmed, owner, chat, monkeypatch):
    monkeypatch.delenv("EVA_JUDGE_KEY", raising=False)
    with serving(SAID) as server:
        chat(server.address, key_variable="EVA_JUDGE_KEY")
        job = asked(filmed, owner, "seer")
        assert (job.attempts, job.status) == (1, JobStatus.QUEUED)
        assert job.error.startswith("judge seer: the variable EVA_JUDGE_KEY")
        assert (server.heard, Judgement.objects.count()) == ([], 0)
        monkeypatch.setenv("EVA_JUDGE_KEY", "sk-1")
        Job.objects.update(not_before=None)
        run_queue("gpu")
    assert Judgement.objects.count() == 16


def test_trials_without_pictures_are_passed_over_and_named(filmed, owner, chat):
    first, second = [handout.trial.episode for handout in filmed.handouts.order_by("number")[:2]]
    (preview_folder(first.uuid) / "top.mp4").unlink()
    preview_folder(first.uuid).rmdir()
    (preview_folder(second.uuid) / "top.mp4").write_bytes(b"no video")
    with serving(SAID) as server:
        chat(server.address)
        job = asked(filmed, owner, "seer")
    assert job.result == {"shown": 15, "left": 1, "without_pictures": [first.trial.handout.code]}
    assert second.trial.judgements.get().reason == "its pictures cannot be read"
    assert len(server.heard) == 14


def test_a_trial_that_counts_no_longer_when_the_answer_comes_is_not_judged(filmed, chat, bench, monkeypatch):
    first = filmed.handouts.order_by("number").first().trial

    def shown(episode):
        Trial.objects.filter(pk=first.pk).update(status="voided")
        return trial_stills(episode)

    monkeypatch.setattr(automatic, "trial_stills", shown)
    with serving(SAID) as server:
        chat(server.address)
        assert automatic.judge_next_trial(plan=filmed, name="seer")
        assert len(server.heard) == 1
    assert (Judgement.objects.count(), first.judgements.count()) == (0, 0)


def everything(plan):
    """All that is said of a plan but what judges said, as bytes."""
    caching.clear_caches()
    found = report_numbers(PlanResult(plan))
    found.pop("judges")
    plan.refresh_from_db()
    rows = {
        "numbers": found,
        "trials": [row for page in outcome_pages(PlanResult(plan)) for row in page],
        "scores": list(Score.objects.order_by("pk").values()),
        "states": list(Trial.objects.order_by("pk").values()),
        "plan": [plan.state, plan.digest, plan.commitment, plan.at_reveal, plan.closed_because],
        "handouts": list(plan.handouts.order_by("pk").values()),
        "ratings": rater_agreement(plan),
    }
    return json.dumps(rows, default=str).encode()


@pytest.mark.exhaustive
def test_with_and_without_judges_the_analysis_is_the_same_to_the_byte(truth, owner, chat, bench):
    rater = builders.user("rita")
    for reached in (True, False, True):
        handout = rating_queue.next_to_rate(rater).found
        ticks = bench.ticks(True, reached, reached)
        rating_queue.save_rating(user=rater, plan=truth, code=handout.code, milestones=ticks)
    reveal_plan(user=owner, plan=truth)
    before = everything(truth)
    with serving(SAID) as server:
        chat(server.address)
        asked(truth, owner, "truth")
        asked(truth, owner, "seer")
    assert Judgement.objects.count() == 32
    assert len(judge_agreement(truth)) == 2
    assert everything(truth) == before
    assert rater_agreement(truth)["ratings"] == 3
    for trial in Trial.objects.select_related("verdict"):
        assert success_of(scores_file(trial.episode_id)) == trial.verdict.success


def test_a_judge_is_held_against_the_score_that_stood_then(truth, owner, bench):
    asked(truth, owner, "truth")
    before = judge_agreement(truth)
    trial = truth.handouts.get(number=1).trial
    turned = not trial.verdict.success
    ticks = bench.ticks(True, turned, turned)
    services.score_trial(user=bench.operator, trial=trial, milestones=ticks, reason="the bench is right")
    assert judge_agreement(truth) == before


def test_neither_a_judge_nor_a_second_rater_judges_by_another_scene_than_the_frozen_one(filmed, owner, chat):
    Milestone.objects.filter(order=1).update(required=True)
    handout, _ = rating_queue.next_to_rate(rita := builders.user("rita"))[:2]
    ticks = dict.fromkeys(handout.trial.scene.milestones.values_list("pk", flat=True), True)
    with pytest.raises(Conflict, match="milestone 1: required was False, is True"):
        rating_queue.save_rating(user=rita, plan=filmed, code=handout.code, milestones=ticks)
    with serving(SAID) as server:
        chat(server.address)
        job = asked(filmed, owner, "seer")
        assert "milestone 1: required was False, is True" in job.error
        assert server.heard == []
    assert not Judgement.objects.exists()


@pytest.mark.exhaustive
def test_what_judges_said_comes_back_from_the_disk(filmed, owner, chat):
    with serving(SAID) as server:
        chat(server.address)
        asked(filmed, owner, "seer")
    before, told = list(Judgement.objects.order_by("uuid").values()), judge_agreement(filmed)
    with without_triggers("results"):
        Judgement.objects.all().delete()
    assert reconcile().restored == 16
    after = list(Judgement.objects.order_by("uuid").values())
    assert [{**row, "id": 0} for row in after] == [{**row, "id": 0} for row in before]
    assert judge_agreement(filmed) == told
    assert reconcile().restored == 0


@pytest.mark.exhaustive
def test_before_the_reveal_it_works_and_nobody_sees_what_it_says(filmed, owner, chat, client, admin, bench):
    page, rows = (
        reverse("result-plan", args=["blocks", 1]),
        reverse("api:plan-judgements", args=["blocks", 1]),
    )
    with serving(said((1, "reached", 0.987654), (2, "reached", 0.9), (3, "reached", 0.9))) as server:
        chat(server.address)
        client.force_login(owner)
        assert "Ask this judge" in client.get(page).content.decode()
        answer = client.post(reverse("result-judge", args=["blocks", 1]), {"judge": "seer"})
        assert (answer.status_code, answer["Location"]) == (302, page)
        run_queue("gpu")
    assert Judgement.objects.count() == 16
    for user in (owner, admin, bench.operator):
        client.force_login(user)
        said_of = client.get(page).content.decode()
        assert not [word for word in ("agree with the scores", "0.99", "0.987", "Brier") if word in said_of]
        assert client.get(rows).status_code == 403
    reveal_plan(user=owner, plan=filmed)
    shown = client.get(page).content.decode()
    assert "Does seer agree with the scores?" in shown
    assert "Brier score" in shown
    assert "chat 1, seer-1" in shown
    assert client.get(rows).json()["total"] == 16


def test_somebody_else_is_not_offered_a_judge_and_a_wrong_one_is_said_on_the_page(
    truth, owner, client, bench
):
    page = reverse("result-plan", args=["blocks", 1])
    client.force_login(bench.operator)
    assert "Ask this judge" not in client.get(page).content.decode()
    client.force_login(owner)
    answer = client.post(reverse("result-judge", args=["blocks", 1]), {"judge": "none"})
    assert (answer.status_code, "there is no judge" in answer.content.decode()) == (404, True)


def test_an_administrator_allows_an_address_in_the_list_and_that_is_on_record(admin, chat, client):
    judge = chat("https://judge.example/v1", allowed=False)
    client.force_login(admin)
    listed = reverse("admin:results_automaticjudge_changelist")
    assert "no: nothing is sent there" in client.get(listed).content.decode()
    client.post(listed, {"action": "allow", "_selected_action": [judge.pk]})
    judge.refresh_from_db()
    assert (judge.allowed_address, judge.allowed_by) == (judge.address, admin)
    assert "by alma on" in client.get(listed).content.decode()
    history = client.get(reverse("admin:results_automaticjudge_history", args=[judge.pk])).content.decode()
    assert "allowed its address: https://judge.example/v1" in history
    client.post(listed, {"action": "forbid", "_selected_action": [judge.pk]})
    judge.refresh_from_db()
    assert (judge.allowed_address, judge.allowed_by, judge.allowed_at) == ("", None, None)
    changed = reverse("admin:results_automaticjudge_change", args=[judge.pk])
    wrong = {"kind": "chat", "address": "http://judge.example", "model": "m", "patience_s": "9"}
    assert "for everybody to read" in client.post(changed, wrong).content.decode()


def test_a_sample_is_even_bounded_and_has_both_ends(filmed):
    assert sample(3) == [0, 1, 2]
    assert sample(12) == [0, 2, 3, 5, 6, 8, 9, 11]
    assert sample(10_000)[0::7] == [0, 9999]
    episode = filmed.handouts.first().trial.episode
    episode.cameras = [f"cam{n}" for n in range(CAMERAS + 2)]
    for camera in episode.cameras[1:]:  # of the first nothing was ever seen
        movie(preview_folder(episode.uuid) / f"{camera}.mp4", pictures=2, size=(1024, 64))
    found = trial_stills(episode)
    assert [still.camera for still in found] == [
        "camera 2",
        "camera 2",
        "camera 3",
        "camera 3",
        "camera 4",
        "camera 4",
    ]
    assert {still.at for still in found} == {0.0, 0.1}


def test_nothing_is_said_of_a_plan_that_no_judge_has_seen(revealed, tmp_path):
    assert judge_agreement(revealed) is None
    assert report_numbers(PlanResult(revealed))["judges"] is None
    with pytest.raises(EvaError, match="there are: none, an administrator adds them"):
        automatic.request_judging(user=revealed.owner, plan=revealed, name="x")
