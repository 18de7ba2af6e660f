import json
import threading
from uuid import uuid4

import pytest
from django.db import IntegrityError, connection, transaction
from django.db.models import ProtectedError

from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotAllowed,
    NotFound,
)
from evaweb.episodes.models import Episode
from evaweb.episodes.selectors import why_unrecorded
from evaweb.jobs.models import Job
from evaweb.records import journal as disk
from evaweb.trials import services, voids
from evaweb.trials.lifecycle import TRANSITIONS, Transition
from evaweb.trials.models import Checkpoint, Evaluation, Milestone, Position, Score, Trial, TrialStatus
from evaweb.trials.record import JUDGEMENTS
from evaweb.trials.selectors import statistics
from runtime.recording.base import Outcome
from tests.evaweb.trials import builders
from tests.processes import eventually
from tests.runtime.recording.samples import row
from tests.runtime.recording.test_episode import begun


def lines(uuid):
    return [json.loads(line) for line in JUDGEMENTS.path(uuid).read_text("utf-8").splitlines()]


def score(bench, trial, *reached, **given):
    ticks = bench.ticks(*reached) if reached else bench.ticks(True, True, True)
    return services.score_trial(**{"user": bench.operator, "trial": trial, "milestones": ticks, **given})


# --- preparing ---------------------------------------------------------------------------------------------


def test_a_correction_that_says_nothing_of_times_keeps_those_that_are_still_ticked(bench):
    trial = bench.ended()
    one, two, _ = keys = list(bench.ticks(True, True, True))
    score(bench, trial, True, True, False, times={one: 2.5, two: 4.0})
    fewer = score(bench, trial, True, False, False, reason="it slid")
    assert list(fewer.outcomes.values_list("milestone", "at_s")) == [(one, 2.5), (two, None), (keys[2], None)]
    none = score(bench, trial, True, False, False, reason="not seen when", times={})
    assert [row.at_s for row in none.outcomes.all()] == [None] * 3
    score(bench, trial, True, False, False, reason="seen", times={one: 2.5})
    Milestone.objects.filter(pk=one).update(time_limit_s=1)
    assert (
        score(bench, trial, True, True, False, reason="seen again").outcomes.exclude(at_s=None).count() == 0
    )


def test_a_trial_is_prepared_on_the_stations_own_open_bench(bench):
    trial = bench.prepare()
    assert (trial.number, trial.attempt, trial.status) == (1, 1, "prepared")
    assert trial.evaluation.kind == Evaluation.Kind.OPEN_BENCH
    assert trial.evaluation.station == bench.station
    assert (trial.instruction, trial.time_limit_s) == ("put the block on the plate", 40)
    assert trial.operator == bench.operator


def test_the_open_bench_of_a_station_is_made_once(bench):
    first = bench.scored().evaluation
    assert bench.prepare().evaluation == first
    assert Evaluation.objects.count() == 1


def test_every_checkpoint_meets_the_same_seed_and_every_number_another_one(bench):
    first, second = bench.scored(), bench.scored()
    other = Checkpoint.objects.create(name="other")
    assert bench.prepare(checkpoint=other).seed == first.seed
    assert first.seed != second.seed


def test_a_station_that_is_real_has_no_seed(bench):
    bench.station.simulated = False
    assert bench.prepare().seed is None


def test_the_next_trial_has_the_next_number_and_positions_count_apart(bench):
    assert bench.scored().number == 1
    assert bench.scored().number == 2
    assert bench.scored(position=2).number == 1


@pytest.mark.parametrize("status", ["interrupted", "voided", "abandoned"])
def test_what_does_not_count_is_repeated_as_a_new_attempt_of_the_same_number(bench, status):
    bench.scored()
    lost = bench.prepare()
    Trial.objects.filter(pk=lost.pk).update(status=status)
    again = bench.prepare()
    assert (again.number, again.attempt) == (2, 2)
    assert Trial.objects.get(pk=lost.pk).status == status
    assert again.seed == lost.seed


def test_a_voided_trial_in_the_middle_is_repeated_before_the_next_number(bench):
    first = bench.scored()
    bench.scored()
    voids.void_trial(user=bench.operator, trial=first, reason="the plate was missing")
    again = bench.prepare()
    assert (again.number, again.attempt) == (1, 2)


@pytest.mark.parametrize(
    ("status", "what_to_do"),
    [("prepared", "abandon it"), ("running", "stop it"), ("paused", "resume it"), ("ended", "score it")],
)
def test_no_trial_is_prepared_while_another_is_not_finished(bench, status, what_to_do):
    trial = bench.prepare()
    Trial.objects.filter(pk=trial.pk).update(status=status)
    with pytest.raises(Conflict, match=f"trial {trial.pk} .*{what_to_do}"):
        bench.prepare(position=2)
    assert Trial.objects.count() == 1


def test_the_database_itself_refuses_two_open_trials_at_a_station(bench):
    trial = bench.prepare()
    trial.pk, trial.number, trial.uuid = None, 2, uuid4()
    with pytest.raises(IntegrityError), transaction.atomic():
        trial.save(force_insert=True)


def test_the_database_itself_refuses_the_same_attempt_twice(bench):
    trial = bench.scored()
    trial.pk, trial.uuid = None, uuid4()
    with pytest.raises(IntegrityError), transaction.atomic():
        trial.save(force_insert=True)


def test_a_number_that_somebody_takes_at_the_same_moment_is_counted_anew(bench, monkeypatch):
    taken = [(1, 1), (1, 1)]  # what a slow reader saw
    bench.scored()
    real = services._next_attempt
    monkeypatch.setattr(services, "_next_attempt", lambda key: taken.pop() if taken else real(key))
    assert bench.prepare().number == 2


@pytest.mark.parametrize("kind", ["station", "scene", "checkpoint"])
def test_what_is_switched_off_is_not_tried(bench, kind):
    thing = getattr(bench, kind)
    thing.active = False
    with pytest.raises(Conflict, match=f"{kind} {thing.name} is switched off"):
        bench.prepare()


def test_a_position_of_another_scene_is_refused(bench):
    other = builders.scene("other-scene")
    with pytest.raises(NotFound, match="not one of scene block-on-plate"):
        services.prepare_trial(
            user=bench.operator,
            station=bench.station,
            scene=bench.scene,
            position=other.positions.first(),
            checkpoint=bench.checkpoint,
        )


@pytest.mark.parametrize("seed", [-1, 2**31])
def test_seeds_that_cannot_be_are_refused(bench, seed):
    with pytest.raises(EvaError, match="allowed: 0 to 2147483647"):
        bench.prepare(seed=seed)


def test_a_viewer_can_neither_prepare_nor_score_nor_void_nor_abandon(bench):
    viewer = builders.user("vic", "viewer")
    with pytest.raises(NotAllowed, match="vic is a viewer"):
        bench.prepare(user=viewer)
    trial = bench.ended()
    for act in (
        lambda: score(bench, trial, user=viewer),
        lambda: voids.void_trial(user=viewer, trial=trial, reason="because"),
        lambda: services.abandon_trial(user=viewer, trial=trial),
    ):
        with pytest.raises(NotAllowed):
            act()
    trial.refresh_from_db()
    assert trial.status == "ended"


@pytest.mark.slow
@pytest.mark.django_db(transaction=True)
def test_of_eight_people_who_prepare_at_once_one_gets_the_station(settings):
    bench = builders.bench()
    outcomes, start = [], threading.Barrier(8)

    def press():
        start.wait()
        try:
            outcomes.append(bench.prepare().pk)
        except Conflict as refused:
            outcomes.append(str(refused))
        finally:
            connection.close()

    threads = [threading.Thread(target=press) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len([found for found in outcomes if isinstance(found, int)]) == 1
    assert len([found for found in outcomes if "is prepared" in str(found)]) == 7
    assert Trial.objects.count() == 1


# --- scoring -----------------------------------------------------------------------------------------------


def test_success_is_all_required_milestones_and_the_score_the_share_of_points(bench):
    trial = bench.ended()
    found = score(bench, trial, True, False, True)
    assert (found.success, found.score) == (True, 0.75)
    assert trial.status == "scored"
    assert trial.verdict == found
    other = score(bench, bench.ended(), True, True, False)
    assert (other.success, other.score) == (False, 0.5)


def test_milestones_are_kept_as_they_were_when_scored(bench):
    trial = bench.scored()
    bench.scene.milestones.update(text="something else", points=9)
    bench.scene.milestones.first().delete()
    kept = trial.verdict.outcomes.values_list("text", "points", "required", "reached")
    assert list(kept) == [
        ("held", 1, False, True),
        ("lifted", 1, False, True),
        ("on the plate", 2, True, True),
    ]


def test_without_required_milestones_success_has_to_be_said(bench):
    bench.scene.milestones.update(required=False)
    trial = bench.ended()
    with pytest.raises(EvaError, match="success is missing"):
        score(bench, trial, True, True, True)
    assert score(bench, trial, True, True, True, success=False).success is False


def test_without_any_milestone_the_score_is_the_success(bench):
    trial = bench.ended()
    Milestone.objects.all().delete()
    found = services.score_trial(user=bench.operator, trial=trial, milestones={}, success=True)
    assert (found.success, found.score) == (True, 1.0)


def test_in_the_name_of_a_bench_nobody_scores_anything_but_what_it_says(bench):
    for order, name in ((1, "held"), (2, "lifted"), (3, "on_plate")):
        bench.scene.milestones.filter(order=order).update(truth=name)
    trial = bench.ended()

    def score(*reached):
        return services.score_trial(
            user=bench.operator, trial=trial, milestones=bench.ticks(*reached), source="truth"
        )

    with pytest.raises(EvaError, match=r"the bench of trial .* reported no truth"):
        score(True, False, False)
    said = {"held": True, "lifted": False, "on_plate": False}
    Trial.objects.filter(pk=trial.pk).update(truth={"milestones": {"held": True, "on_plate": False}})
    with pytest.raises(EvaError, match="'lifted' in the bench's truth, which reports held, on_plate"):
        score(True, False, False)
    Trial.objects.filter(pk=trial.pk).update(truth={"milestones": said})
    for ticks, said in (((True, False, True), "on the plate"), ((True, True, False), "lifted")):
        with pytest.raises(EvaError, match=rf"'{said}' = True, the bench of trial .* says False"):
            score(*ticks)
    assert not trial.scores.exists()
    assert (score(True, False, False).source, trial.scores.count()) == ("truth", 1)


@pytest.mark.parametrize(
    ("ordered", "at", "counts"),
    [
        (False, {"held": 1.0, "lifted": 2.0, "on_plate": 3.0}, (True, True, True)),
        (False, {"held": 1.0, "lifted": 9.0, "on_plate": 3.0}, (True, False, True)),  # too late
        (
            True,
            {"held": 1.0, "lifted": 9.0, "on_plate": 9.5},
            (True, False, False),
        ),  # after one that is missed
        (True, {"held": 4.0, "lifted": 2.0, "on_plate": 5.0}, (True, False, False)),  # before the first
    ],
)
def test_what_the_bench_said_counts_in_time_and_in_order_alone(bench, ordered, at, counts):
    for order, name in enumerate(at, 1):
        limit = 5.0 if name == "lifted" else None
        bench.scene.milestones.filter(order=order).update(truth=name, time_limit_s=limit)
    bench.scene.ordered = ordered
    bench.scene.save()
    trial = bench.ended()
    truth = {"milestones": dict.fromkeys(at, True), "reached": at, "success": True}
    Trial.objects.filter(pk=trial.pk).update(truth=truth)
    made = services.score_trial(user=bench.operator, trial=trial, milestones={}, source="truth")
    outcomes = list(made.outcomes.order_by("order"))
    assert tuple(outcome.reached for outcome in outcomes) == counts
    assert [outcome.at_s for outcome in outcomes] == [
        seconds if reached else None for seconds, reached in zip(at.values(), counts, strict=True)
    ]


def test_a_success_that_contradicts_the_required_milestones_is_refused(bench):
    with pytest.raises(EvaError, match="contradicts the required milestones"):
        score(bench, bench.ended(), True, True, False, success=True)


@pytest.mark.parametrize("key", ["", " ", "x", "999999", -1, None, "１"])
def test_unknown_milestones_are_refused_with_those_that_there_are(bench, key):
    trial = bench.ended()
    with pytest.raises(EvaError, match=r"is not one of this scene; allowed: \d+ \(held\)"):
        services.score_trial(
            user=bench.operator, trial=trial, milestones={**bench.ticks(True, True, True), key: True}
        )
    assert Score.objects.count() == 0


def test_a_milestone_that_is_not_answered_is_refused(bench):
    ticks = bench.ticks(True, True, True)
    missing = ticks.popitem()[0]
    with pytest.raises(EvaError, match=f"milestone {missing} is not answered"):
        services.score_trial(user=bench.operator, trial=bench.ended(), milestones=ticks)


def test_an_answer_that_is_neither_true_nor_false_is_refused(bench):
    ticks = dict.fromkeys(bench.ticks(True, True, True), "yes")
    with pytest.raises(EvaError, match="allowed: true, false"):
        services.score_trial(user=bench.operator, trial=bench.ended(), milestones=ticks)


def test_to_score_twice_is_a_correction_that_needs_a_reason_and_counts(bench):
    trial = bench.scored(success=True)
    first = trial.verdict
    with pytest.raises(EvaError, match="give a reason"):
        score(bench, trial, True, True, False)
    second = score(bench, trial, True, True, False, reason="the block stood on the rim")
    assert list(trial.scores.all()) == [first, second]
    assert trial.verdict == second
    assert Score.objects.get(pk=first.pk).success is True


@pytest.mark.parametrize("uuid", [None, "own"])
def test_who_scores_once_more_because_the_answer_was_lost_gets_the_first_answer(bench, uuid):
    trial, uuid = bench.ended(), uuid and uuid4()
    said = {"note": "clean", "times": {str(next(iter(bench.ticks(True, True, True)))): 3}, "uuid": uuid}
    first = score(bench, trial, True, True, True, **said)
    assert uuid in (None, first.uuid)
    assert score(bench, trial, True, True, True, **said) == first
    corrected = score(bench, trial, True, True, False, reason="on the rim", uuid=uuid and uuid4())
    again = score(bench, trial, True, True, False, reason="on the rim", uuid=uuid and corrected.uuid)
    assert again == corrected
    assert list(trial.scores.all()) == [first, corrected]
    assert len(lines(trial.episode_id or trial.uuid)) == 2
    trial.refresh_from_db()
    assert trial.verdict == corrected
    if uuid:
        assert score(bench, trial, True, True, True, **said) == first, "whatever came after it"


def test_a_correction_that_comes_late_takes_no_newer_ones_place(bench):
    trial = bench.scored(success=True)
    score(bench, trial, True, True, False, reason="on the rim")
    newer = score(bench, trial, True, True, True, reason="it fell off afterwards")
    with pytest.raises(Conflict, match=r"you sent just this for trial .* before, and it was corrected since"):
        score(bench, trial, True, True, False, reason="on the rim")
    trial.refresh_from_db()
    assert trial.verdict == newer
    assert score(bench, trial, True, True, False, reason="on the rim after all").success is False


def test_the_uuid_of_a_score_says_the_same_for_ever(bench):
    trial, uuid = bench.ended(), uuid4()
    score(bench, trial, True, True, True, uuid=uuid)
    other = builders.user("otto")
    said = [
        lambda: score(bench, trial, True, True, False, uuid=uuid, reason="on the rim"),
        lambda: score(bench, trial, True, True, True, uuid=str(uuid), note="clean"),
        lambda: score(bench, trial, True, True, True, uuid=uuid, user=other),
        lambda: score(bench, bench.ended(), True, True, True, uuid=uuid),
    ]
    for again in said:
        with pytest.raises(Conflict, match=f"uuid {uuid} is that of another score .trial {trial.pk}.: give"):
            again()
    with pytest.raises(EvaError, match="uuid 'seven': must be a UUID such as"):
        score(bench, trial, True, True, True, uuid="seven")
    assert len(lines(trial.episode_id or trial.uuid)) == 1


def test_what_somebody_else_says_word_by_word_is_no_repetition(bench):
    trial = bench.scored()
    ticks = {outcome.milestone_id: outcome.reached for outcome in trial.verdict.outcomes.all()}
    with pytest.raises(EvaError, match="has a score already"):
        services.score_trial(user=builders.user("otto"), trial=trial, milestones=ticks)


def test_who_voids_or_gives_up_once_more_gets_the_first_answer(bench):
    voided = voids.void_trial(user=bench.operator, trial=bench.scored(), reason="the camera fell")
    at = voided.voided_at
    again = voids.void_trial(user=bench.operator, trial=voided, reason="the camera fell")
    assert (again.status, again.voided_at, len(lines(voided.episode_id or voided.uuid))) == ("voided", at, 2)
    with pytest.raises(Conflict, match="cannot be voided"):
        voids.void_trial(user=bench.operator, trial=voided, reason="another reason")
    given_up = services.abandon_trial(user=bench.operator, trial=bench.prepare(), reason="wrong block")
    assert services.abandon_trial(user=bench.operator, trial=given_up, reason="wrong block") == given_up
    with pytest.raises(Conflict, match="cannot be abandoned"):
        services.abandon_trial(user=bench.operator, trial=given_up)


def test_a_score_is_never_changed(bench):
    found = bench.scored().verdict
    found.success = False
    with pytest.raises(TypeError, match="a correction is another score"):
        found.save()
    assert Score.objects.get(pk=found.pk).success is True


@pytest.mark.parametrize("status", ["prepared", "running", "paused", "voided", "abandoned"])
def test_what_has_not_ended_or_does_not_count_cannot_be_scored(bench, status):
    trial = bench.prepare()
    Trial.objects.filter(pk=trial.pk).update(status=status)
    with pytest.raises(Conflict, match="cannot be scored"):
        score(bench, trial)
    assert not JUDGEMENTS.path(trial.uuid).exists()


def test_an_interrupted_trial_can_be_scored_until_it_is_repeated(bench):
    first = bench.ended()
    Trial.objects.filter(pk=first.pk).update(status="interrupted")
    assert score(bench, first, False, False, False, failure="collision").success is False
    second = bench.prepare()
    assert second.number == 2
    Trial.objects.filter(pk=second.pk).update(status="interrupted")
    assert bench.prepare().attempt == 2
    with pytest.raises(Conflict, match="has been repeated"):
        score(bench, second)


def test_every_score_is_a_line_on_the_disk_beside_its_row(bench):
    trial = bench.ended()
    uuid = trial.episode_id
    note = "zuerst ⟂ daneben,\nthen “on it” — 好\t\u2028end"
    score(bench, trial, True, True, False, note=note, failure="slipped")
    score(bench, trial, True, True, True, reason="seen on the video")
    first, second = lines(uuid)
    assert (first["kind"], first["success"], first["note"], first["failure"]) == (
        "score",
        False,
        note,
        "slipped",
    )
    assert [second["success"], second["score"], second["reason"]] == [True, 1.0, "seen on the video"]
    assert first["trial"]["uuid"] == str(trial.uuid)
    assert [m["reached"] for m in first["milestones"]] == [True, True, False]
    assert [first["uuid"], second["uuid"]] == [str(row.uuid) for row in trial.scores.all()]


@pytest.mark.parametrize("status", ["ended", "interrupted"])
@pytest.mark.parametrize(
    ("episode", "why"),
    [
        (None, "nothing of its run was recorded"),
        ({"status": "finished"}, "episode .* of its run has no rows"),
        ({"status": "recording"}, "episode .* of its run has no folder: nothing of it is on this disk"),
        ({"status": "missing"}, "episode .* of its run has no folder"),
    ],
)
def test_what_left_no_recorded_row_is_never_scored_and_can_be_voided(bench, status, episode, why):
    trial = bench.prepare()
    found = Episode.objects.create(station=bench.station, **episode) if episode else None
    Trial.objects.filter(pk=trial.pk).update(status=status, duration_s=0.01, episode=found)
    with pytest.raises(
        Conflict, match=f"trial {trial.pk} cannot be scored: {why}.*; what never ran is voided"
    ):
        score(bench, trial)
    assert not JUDGEMENTS.path(trial.episode_id or trial.uuid).exists()
    assert [row.summary.success.n for row in statistics()] == [0]
    assert voids.void_trial(user=bench.operator, trial=trial, reason="it never ran").status == "voided"


def test_what_is_still_being_closed_is_scored_as_soon_as_a_row_of_it_is_on_the_disk(bench, tmp_path):
    journal_of, folder = begun(tmp_path / "episodes")
    trial = builders.finished_trial(bench.prepare(), uuid=folder.name, status="recording", frames=0)
    with pytest.raises(
        Conflict, match=r"no row of episode .* is on the disk yet: look again once it is closed"
    ):
        score(bench, trial)
    journal_of.append(row(0))
    eventually(lambda: not why_unrecorded(episode=trial.episode), "a row on the disk")
    assert score(bench, trial).success is True
    journal_of.end(Outcome("finished", "stopped", 1.7e9))


def test_a_correction_of_what_counted_already_needs_no_recording_any_more(bench):
    trial = bench.scored()
    Episode.objects.update(status="missing", frames=0)
    trial.refresh_from_db()
    assert score(bench, trial, False, False, False, reason="seen on a copy").success is False


def test_a_line_that_was_torn_by_a_crash_stays_a_line_of_its_own():
    uuid = uuid4()
    JUDGEMENTS.append(uuid, {"n": 1})
    with JUDGEMENTS.path(uuid).open("ab") as file:
        file.write(b'{"n": 2, "to')
    JUDGEMENTS.append(uuid, {"n": 3})
    assert JUDGEMENTS.path(uuid).read_bytes().split(b"\n") == [b'{"n":1}', b'{"n": 2, "to', b'{"n":3}', b""]


def test_what_cannot_be_written_to_the_disk_is_no_score(bench, monkeypatch):
    trial = bench.ended()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(disk, "append_durably", full)
    with pytest.raises(EvaError, match="not kept: No space left on device"):
        score(bench, trial)
    trial.refresh_from_db()
    assert trial.status == "ended"
    assert Score.objects.count() == 0


def test_a_score_and_a_correction_ask_for_publication(bench):
    trial = bench.ended()
    uuid = trial.episode_id
    score(bench, trial)
    job = Job.objects.get(key=f"publish:{uuid}")
    job.status = "done"
    job.save()
    score(bench, trial, reason="again")
    assert Job.objects.filter(key=f"publish:{uuid}").count() == 2


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"note": "x" * 8001}, "note has 8001 characters; allowed: at most 8000"),
        ({"failure": "x" * 61}, "failure has 61 characters"),
        ({"note": "a\x00b"}, r"U\+0000"),
        ({"source": "oracle"}, "allowed: human, truth"),
        ({"failure": "slipped"}, "but the trial is a success"),
    ],
)
def test_words_that_cannot_be_kept_are_refused(bench, given, sentence):
    trial = bench.ended()
    with pytest.raises(EvaError, match=sentence):
        score(bench, trial, **given)
    assert Score.objects.count() == 0


def test_the_note_of_one_trial_is_not_that_of_the_next(bench):
    first = bench.ended()
    score(bench, first, note="about the first")
    assert score(bench, bench.ended()).note == ""


# --- voiding, abandoning -----------------------------------------------------------------------------------


def test_void_is_not_fail_and_says_who_and_why(bench):
    trial = bench.scored(success=False)
    voids.void_trial(user=bench.operator, trial=trial, reason="  a hand was in the picture ")
    assert (trial.status, trial.reason) == ("voided", "a hand was in the picture")
    assert trial.voided_by == bench.operator
    assert trial.scores.count() == 1
    assert [line["kind"] for line in lines(trial.episode_id)] == ["score", "void"]


@pytest.mark.parametrize("reason", ["", "  \n"])
def test_nothing_is_voided_without_a_reason(bench, reason):
    trial = bench.ended()
    with pytest.raises(EvaError, match="reason is empty"):
        voids.void_trial(user=bench.operator, trial=trial, reason=reason)


def test_only_a_trial_that_never_ran_is_abandoned(bench):
    with pytest.raises(Conflict, match="cannot be abandoned"):
        services.abandon_trial(user=bench.operator, trial=bench.ended())
    Trial.objects.update(status="voided")
    trial = bench.prepare()
    services.abandon_trial(user=bench.operator, trial=trial, reason="wrong checkpoint")
    assert (trial.status, trial.reason) == ("abandoned", "wrong checkpoint (ann)")


def test_the_table_names_every_status_and_nothing_leaves_voided():
    final = {TrialStatus.VOIDED, TrialStatus.NOT_NEEDED}
    assert {before for before, _ in TRANSITIONS} | final == set(TrialStatus)
    assert {move for _, move in TRANSITIONS} == set(Transition)
    assert not [move for before, move in TRANSITIONS if before is TrialStatus.VOIDED]


def test_a_position_that_was_tried_cannot_be_deleted(bench):
    bench.prepare()
    with pytest.raises(ProtectedError):
        Position.objects.filter(number=1).delete()
