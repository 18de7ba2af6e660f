"""A database that was lost comes back from the disk: real journals, the services' own lines, nothing mocked but the
wire."""

import json
import shutil
from uuid import uuid4

import pytest
from django.contrib.auth.models import User
from django.db import OperationalError

from evaweb.api.trials import TrialDetail
from evaweb.blinding.visibility import FULL_VISIBILITY
from evaweb.episodes import reconcile as reconciling
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.reconcile import reconcile
from evaweb.jobs.models import Job
from evaweb.stations.models import Command, Station
from evaweb.trials import restoring, services, voids
from evaweb.trials.models import (
    Checkpoint,
    Evaluation,
    FailureTerm,
    Milestone,
    MilestoneOutcome,
    Position,
    Scene,
    Score,
    Trial,
    VoidRequest,
)
from evaweb.trials.record import JUDGEMENTS
from evaweb.trials.selectors import statistics, trial_get, trial_list
from tests.evaweb.trials import builders
from tests.evaweb.trials.whole_lab import lab
from tests.evaweb.unguarded import without_triggers

__all__ = ["lab"]

pytestmark = pytest.mark.django_db

RECORDS = (MilestoneOutcome, Score, VoidRequest, Trial, Evaluation, Episode, Command, Job)
CHOICES = (Milestone, Position, Scene, Checkpoint, Station, User)


def lose(*models):
    """All rows of these are gone, as with the file they were in."""
    with without_triggers("trials"):
        Trial.objects.update(verdict=None)
        for model in models:
            model.objects.all().delete()


def told(*without):
    """The trials as the API tells them, the newest first."""
    found = [TrialDetail.of(trial_get(id=trial.pk), FULL_VISIBILITY) for trial in trial_list()]
    for trial in found:
        trial["scores"] = [{**one, "milestones": outcomes(one["milestones"])} for one in trial["scores"]]
    return [{name: value for name, value in trial.items() if name not in without} for trial in found]


def outcomes(rows):
    return [(row.order, row.text, row.points, row.required, row.reached) for row in rows]


def counted():
    return [
        (row.scene.name, row.checkpoint.name, row.summary, row.to_score, row.interrupted, row.voided)
        for row in statistics()
    ]


def everything():
    """All rows of this app, and when they were changed last."""
    return {model: list(model.objects.order_by("pk").values()) for model in (*RECORDS, *CHOICES)}


@pytest.fixture
def judged(lab):
    """Trials of every kind that is over: scored, corrected, voided, repeated without a recording, interrupted."""
    builders.failure_terms()
    lab.score(lab.run(), True, True, True, note="zuerst ⟂, dann gut")
    corrected = lab.run(position=2)
    lab.score(corrected, True, False, False, failure="dropped", failure_phase="grasp")
    lab.score(corrected, True, True, True, reason="seen on the video")
    voided = lab.run()
    lab.score(voided, True, False, False)
    voids.void_trial(user=lab.bench.operator, trial=voided, reason="a hand was in the picture")
    lab.bench.unrecorded(success=False)
    lab.run(smoke=True)
    assert [trial.status for trial in trial_list().order_by("pk")] == [
        "scored",
        "scored",
        "voided",
        "scored",
        "interrupted",
    ]
    return lab


def test_trials_scores_and_statistics_of_a_lost_database_come_back(judged):
    before, counts = told(), counted()
    assert counts[0][2].success.n == 3
    assert "grasp" in {one["failure_phase"] for trial in before for one in trial["scores"]}
    lose(*RECORDS, FailureTerm)
    report = reconcile()
    assert (report.problems, report.restored) == ((), 5 + 5)
    # The interrupted one was never judged: the times and the reason of its run are those of its recording.
    found, exact = told(), {name: before[0][name] for name in ("started_at", "ended_at", "reason")}
    assert [{**found[0], **exact}, *found[1:]] == before
    assert "smoke" in found[0]["reason"]
    assert found[0]["started_at"] < found[0]["ended_at"]
    assert counted() == counts


def test_a_score_that_the_database_took_at_the_second_time_comes_back_once(lab, monkeypatch):
    trial, uuid = lab.run(), uuid4()

    def away(score, *given, **named):
        raise OperationalError("disk I/O error")

    with monkeypatch.context() as patch:
        patch.setattr(Score, "save", away)
        with pytest.raises(OperationalError):
            lab.score(trial, True, True, True, uuid=uuid, note="first")
    lab.score(trial, True, True, True, uuid=uuid, note="again")
    assert JUDGEMENTS.path(trial.episode_id).read_text().count(str(uuid)) == 2
    lose(*RECORDS)
    assert reconcile().problems == ()
    assert list(Score.objects.values_list("uuid", "note")) == [(uuid, "again")]
    assert Trial.objects.get().verdict.uuid == uuid


def test_a_second_time_changes_nothing(judged):
    lose(*RECORDS)
    reconcile()
    found = everything()
    assert reconcile().restored == 0
    assert everything() == found


@pytest.mark.exhaustive
def test_what_is_all_there_is_left_alone(judged):
    found = everything()
    assert reconcile().restored == 0
    assert everything() == found


@pytest.mark.parametrize("lost", [False, True])
def test_a_score_that_an_earlier_version_took_for_a_run_that_never_began_is_named(lab, lost):
    trial = lab.bench.prepare()
    ghost = Episode.objects.create(station=lab.bench.station, status="recording")
    Trial.objects.filter(pk=trial.pk).update(status="ended", duration_s=0.01, episode=ghost)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(services, "why_unrecorded", lambda episode: "")
        lab.score(trial, True, True, True)
    if lost:
        lose(*RECORDS)
    for _ in range(2):
        (problem,) = reconcile().problems
        assert problem.startswith(
            f"trial {trial.pk} is scored and never ran, episode {ghost.pk} of its run has no"
        )
        assert problem.endswith(": void it with a reason")
    trial = Trial.objects.get()
    voids.void_trial(user=lab.bench.operator, trial=trial, reason="it never ran")
    assert reconcile().problems == ()


def test_a_closed_recording_without_a_row_comes_back_as_an_attempt_that_does_not_count(lab):
    trial = lab.bench.prepare()
    lab.station.until(lambda: str(lab.station.state) == "idle", 30.0, "a state to set up from")
    lab.give(trial, "setup")
    lab.station.until(lambda: str(lab.station.state) == "ready", 60.0, "set-up")
    lab.give(trial, "run")
    lab.give(trial, "stop")
    lab.station.go(5)
    lab.listen()
    lose(*RECORDS)
    reconcile()
    assert (Trial.objects.get().status, Trial.objects.get().episode.frames) == ("interrupted", 0)


@pytest.mark.exhaustive
def test_scenes_checkpoints_and_people_that_are_gone_too_are_made_switched_off(judged):
    before, counts = told(), counted()
    lose(*RECORDS, *CHOICES)
    assert reconcile().problems == ()
    assert [trial["scores"] for trial in told()] == [trial["scores"] for trial in before]
    assert counted() == counts
    scene, checkpoint, ann = Scene.objects.get(), Checkpoint.objects.get(), User.objects.get(username="ann")
    assert (scene.name, scene.active, checkpoint.active) == ("block-on-plate", False, False)
    assert "the database was lost" in scene.criterion
    assert "the database was lost" in checkpoint.description
    assert all("the database was lost" in position.description for position in scene.positions.all())
    assert list(scene.milestones.values_list("text", "points", "required")) == [
        ("held", 1, False),
        ("lifted", 1, False),
        ("on the plate", 2, True),
    ]
    assert MilestoneOutcome.objects.filter(milestone=None).count() == 0
    assert (ann.is_active, ann.has_usable_password(), ann.groups.count()) == (False, False, 0)


@pytest.mark.exhaustive
def test_a_rater_whom_nobody_knows_any_more_becomes_a_deactivated_user(judged, caplog):
    name = "dorothea"
    User.objects.filter(username="ann").update(username=name)
    judged.bench.operator.refresh_from_db()
    trial = trial_list().order_by("pk")[0]
    judged.score(trial, False, False, False, reason="seen again")
    lose(*RECORDS)
    User.objects.all().delete()
    reconcile()
    user = User.objects.get(username=name)
    assert (user.is_active, Trial.objects.get(pk=trial.pk).verdict.rater) == (False, user)
    assert f"user {name} was not in the database" in caplog.text


def test_a_trial_that_waits_for_its_score_still_waits_with_the_truth_of_its_bench(lab):
    trial = lab.run()
    assert (trial.status, trial.truth["success"]) == ("ended", False)
    lose(*RECORDS)
    assert reconcile().restored == 1
    found = services.trial_open(lab.bench.station)
    assert (found.uuid, found.pk, found.status, found.truth) == (trial.uuid, trial.pk, "ended", trial.truth)
    assert (found.prepared_at, found.duration_s) == (trial.prepared_at, trial.duration_s)
    assert lab.score(found, True, True, True).success is True


def test_a_judged_trial_whose_publication_was_lost_is_published(lab):
    lab.score(lab.run(), True, True, True)
    lose(*RECORDS)
    reconcile()
    uuid = Episode.objects.get().uuid
    assert sorted(Job.objects.values_list("key", flat=True)) == [f"preview:{uuid}", f"publish:{uuid}"]


@pytest.mark.exhaustive
def test_the_next_trial_goes_on_where_the_lost_ones_ended(judged):
    highest = Trial.objects.order_by("-pk")[0]
    lose(*RECORDS)
    reconcile()
    assert (
        judged.bench.prepare().number,
        judged.bench.station.trials.order_by("-pk")[0].pk,
    ) == (highest.number, highest.pk + 1), "the interrupted one is repeated"


def test_a_number_that_was_given_out_again_makes_the_old_trial_another_number(lab):
    old = lab.run()
    lab.score(old, True, True, True)
    lose(*RECORDS)
    new = lab.bench.scored(success=False)
    assert new.number == old.number
    assert reconcile().problems == ()
    found = Trial.objects.get(uuid=old.uuid)
    assert (found.number, found.attempt, found.verdict.success) == (2, 1, True)
    assert "restored as another number: it was 1, attempt 1" in found.reason
    assert counted()[0][2].success.n == 2


def test_a_row_from_an_old_backup_is_brought_up_to_the_disk(lab):
    trial = lab.run()
    lab.score(trial, True, True, True)
    lose(MilestoneOutcome, Score)
    with without_triggers("trials"):
        Trial.objects.update(status="running", episode=None, ended_at=None, duration_s=None)
    assert reconcile().restored == 1
    found = Trial.objects.get(pk=trial.pk)
    assert (found.status, found.episode_id) == ("scored", trial.episode_id)
    assert (found.ended_at, found.duration_s) == (trial.ended_at, trial.duration_s)


def test_a_recording_that_was_never_bound_to_its_trial_is(lab):
    trial = lab.run()
    Trial.objects.update(episode=None)
    assert reconcile().restored == 0
    assert Trial.objects.get().episode_id == trial.episode_id


def test_a_trial_that_runs_is_none_of_ours_yet(lab):
    trial = lab.run()
    outcome = lab.folder(trial) / "outcome.json"
    kept = outcome.read_bytes()
    outcome.unlink()
    lose(*RECORDS)
    assert (reconcile().restored, Trial.objects.count()) == (0, 0)
    outcome.write_bytes(kept)
    assert (reconcile().restored, Trial.objects.get().uuid) == (1, trial.uuid)


def test_a_score_of_another_trial_is_named(lab):
    first = lab.run()
    lab.score(first, True, True, True)
    second = lab.run()
    line = json.loads(JUDGEMENTS.path(first.episode_id).read_text())
    told = line | {"trial": line["trial"] | {"uuid": str(second.uuid), "id": second.pk}}
    JUDGEMENTS.path(second.episode_id).write_text(json.dumps(told) + "\n")
    (problem,) = reconcile().problems
    assert f"its score {line['uuid']} is of trial {first.pk}" in problem
    assert Trial.objects.get(pk=second.pk).status != "scored"


def test_a_line_cut_in_half_is_left_out_and_told(lab):
    trial = lab.run()
    lab.score(trial, True, False, False)
    lab.score(trial, True, True, True, reason="seen on the video")
    file = JUDGEMENTS.path(trial.episode_id)
    first, second = file.read_bytes().splitlines()
    file.write_bytes(first + b"\n" + second[: len(second) // 2])
    lose(*RECORDS)
    report = reconcile()
    assert report.problems == (f"{file}: line 2 is not whole and was left out: EOF while parsing a string",)
    found = Trial.objects.get()
    assert (found.status, found.verdict.success, found.scores.count()) == ("scored", False, 1)


@pytest.mark.some(3)
@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("success", "yes", "score.success is 'yes'"),
        ("score", 1.5, "score.score is 1.5"),
        ("at", "0001-01-01T00:00:00+14:00", "score.at is '0001-01-01T00:00:00+14:00'"),
        ("trial", {}, "score.trial.uuid is {}"),
        ("failure", "x" * 61, "at most 60 characters"),
        ("kind", "scorE", "Input tag 'scorE'"),
        ("note", "\ud800", "unexpected end of hex escape"),
    ],
)
def test_a_line_that_says_what_cannot_be_is_told_and_keeps_nothing_else(lab, name, value, words):
    damaged = lab.run()
    lab.score(damaged, True, True, True)
    whole = lab.run()
    lab.score(whole, True, True, True)
    file = JUDGEMENTS.path(damaged.episode_id)
    file.write_text(json.dumps(json.loads(file.read_text()) | {name: value}) + "\n")
    lose(*RECORDS)
    (problem,) = reconcile().problems
    assert problem.startswith(f"{file}: line 1 ")
    assert words in problem
    assert dict(Trial.objects.values_list("uuid", "status")) == {damaged.uuid: "ended", whole.uuid: "scored"}


def test_lines_of_several_trials_in_one_file_are_told(lab):
    first = lab.run()
    lab.score(first, True, True, True)
    second = lab.run()
    lab.score(second, True, True, True)
    other = JUDGEMENTS.path(second.episode_id)
    other.write_bytes(other.read_bytes() + JUDGEMENTS.path(first.episode_id).read_bytes())
    lose(*RECORDS)
    (problem,) = reconcile().problems
    assert problem == (
        f"run {second.episode_id}: 1 of its scores are of trial {first.uuid}, its recording is of trial {second.uuid}: "
        "left out"
    )
    assert set(Trial.objects.values_list("uuid", "status")) == {
        (one.uuid, "scored") for one in (first, second)
    }


def test_lines_of_several_trials_without_a_recording_are_told(lab):
    first, second = lab.bench.unrecorded(), lab.bench.unrecorded()
    other = JUDGEMENTS.path(second.uuid)
    other.write_bytes(other.read_bytes() + JUDGEMENTS.path(first.uuid).read_bytes())
    lose(*RECORDS)
    (problem,) = reconcile().problems
    assert f"run {second.uuid}: its scores are of several trials" in problem
    assert Trial.objects.get().uuid == first.uuid


@pytest.mark.some(1)
@pytest.mark.parametrize("recorded", [True, False])
def test_a_copy_of_the_scores_of_another_trial_takes_it_from_nobody(lab, recorded):
    if recorded:
        first = lab.run()
        lab.score(first, True, False, False)
    else:  # a run from Debug: its recording is of no trial
        lab.station.running(6)
        lab.station.stop()
        lab.listen()
        first = None
    second = lab.run()
    lab.score(second, True, True, True)
    early = Episode.objects.order_by("started_at")[0].uuid
    shutil.copy(JUDGEMENTS.path(second.episode_id), JUDGEMENTS.path(early))
    lose(*RECORDS)
    (problem,) = reconcile().problems
    own = f"trial {first.uuid}" if first else "no trial"
    assert (
        problem
        == f"run {early}: 1 of its scores are of trial {second.uuid}, its recording is of {own}: left out"
    )
    found = set(Trial.objects.values_list("uuid", "episode", "status"))
    assert found == {(second.uuid, second.episode_id, "scored")} | (
        {(first.uuid, early, "ended")} if first else set()
    )


@pytest.mark.some(1)
@pytest.mark.parametrize("name", [lambda uuid: str(uuid).upper(), lambda uuid: uuid.hex])
def test_a_file_that_would_not_be_found_by_its_name_is_told(lab, name):
    trial = lab.run()
    lab.score(trial, True, True, True)
    file = JUDGEMENTS.path(trial.episode_id)
    moved = file.rename(file.with_name(f"{name(trial.episode_id)}.jsonl"))
    lose(*RECORDS)
    assert reconcile().problems == (
        f"{moved} is no file of scores: its name is no uuid in lower case with dashes",
    )


def test_a_verdict_outlives_its_recording(lab):
    trial = lab.run()
    lab.score(trial, True, True, True)
    shutil.rmtree(lab.folder(trial))
    lose(*RECORDS)
    assert reconcile().problems == ()
    found = Trial.objects.get()
    assert (found.verdict.success, found.episode.uuid) == (True, trial.episode_id)
    assert found.episode.status == EpisodeStatus.MISSING
    assert found.duration_s == trial.duration_s
    assert not Job.objects.exists()


def test_a_run_that_was_no_trial_stays_none(lab):
    lab.station.running(6)
    lab.station.stop()
    assert reconcile().restored == 0
    assert (Episode.objects.count(), Trial.objects.count()) == (1, 0)


def test_a_score_that_only_the_disk_has_counts_and_is_published(lab):
    trial = lab.run()
    lab.score(trial, True, False, False)
    line = json.loads(JUDGEMENTS.path(trial.episode_id).read_text())
    Job.objects.all().delete()
    uuid = str(uuid4())
    JUDGEMENTS.append(
        trial.episode_id, line | {"uuid": uuid, "success": True, "score": 1.0, "reason": "again"}
    )
    assert reconcile().restored == 1
    found = Trial.objects.get()
    assert (str(found.verdict.uuid), found.scores.count()) == (uuid, 2)
    assert Job.objects.filter(key=f"publish:{trial.episode_id}").exists()


def test_this_app_restores_what_the_episodes_hand_out():
    assert restoring.restore in reconciling._restorers


@pytest.mark.some(1)
@pytest.mark.parametrize("answer", ["", "agreed", "refused"])
def test_voids_that_were_asked_for_and_their_answers_come_back(lab, monkeypatch, answer):
    monkeypatch.setattr(voids, "_rules", [lambda trial: True])
    trial, second = lab.run(), builders.user("sam")
    lab.score(trial, True, False, False)
    voids.void_trial(user=lab.bench.operator, trial=trial, reason="the plate had slipped")
    lab.score(lab.run(), True, True, True)
    if answer:
        voids.answer_void(user=second, trial=trial, agree=answer == "agreed", reason="seen on the video")
    before = told()
    assert [(one["status"], one["attempt"]) for one in before] == {
        "": [("scored", 2), ("void_asked", 1)],
        "agreed": [("scored", 2), ("voided", 1)],
        "refused": [("voided", 2), ("scored", 1)],
    }[answer]
    asked = before[1]["void_requests"]
    assert [(one["by"], one["answer"]) for one in asked] == [(lab.bench.operator.username, answer)]
    lose(*RECORDS)
    assert reconcile().problems == ()
    assert told() == before
    assert reconcile().restored == 0


def test_an_answer_that_a_backup_does_not_have_comes_back(lab, monkeypatch):
    monkeypatch.setattr(voids, "_rules", [lambda trial: True])
    trial = lab.run()
    lab.score(trial, True, False, False)
    voids.void_trial(user=lab.bench.operator, trial=trial, reason="the plate had slipped")
    voids.answer_void(user=builders.user("sam"), trial=trial, agree=False, reason="it had not")
    before = told()
    with without_triggers("trials"):
        trial.void_requests.update(answer="", answer_reason="", answered_by=None, answered_at=None)
        Trial.objects.filter(pk=trial.pk).update(status="void_asked")
    assert reconcile().restored == 1
    assert told() == before
