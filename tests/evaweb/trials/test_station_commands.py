from functools import partial
from uuid import uuid4

import pytest

from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.stations.models import Command
from evaweb.stations.runtime_client import NoAnswer
from evaweb.trials import services, voids
from evaweb.trials.models import Checkpoint, Trial
from evaweb.trials.station_commands import trial_command
from runtime.benches.schema import load_schema
from tests.evaweb.trials import builders
from tests.evaweb.trials.builders import BOOT


def give(bench, trial, kind, **given):
    order = {"user": bench.operator, "page": "p1", "epoch": 3, "boot": BOOT, "sequence": 5}
    return trial_command(trial=trial, kind=kind, **{**order, **given})


def heard(wire, kind):
    return [command for command in wire.heard if command.kind == kind]


def test_set_up_takes_policy_task_checkpoint_and_bench_with_it(bench, wire):
    trial = bench.prepare(seed=42)
    row = give(bench, trial, "setup")
    assert row.status == "accepted"
    (command,) = heard(wire, "setup")
    assert command.args == {
        "policy": {"url": "ws://127.0.0.1:8000"},
        "task": "put the block on the plate",
        "checkpoint": {"id": bench.checkpoint.pk, "name": "pi0-block"},
        "bench": {
            "id": str(row.pk),
            "seed": 42,
            "positions": {"block": [0.1, 0.3, 0], "plate": [-0.1, 0.3]},
            "of": "tabletop",
            "schema_digest": load_schema("tabletop").digest,
        },
    }
    assert (command.holder, command.epoch, command.boot, command.sequence) == ("web:ann:p1", 3, BOOT, 5)
    assert trial.setup == row.pk


def test_a_real_bench_is_not_laid_out_by_command(bench, wire):
    bench.station.simulated = False
    bench.station.save()
    give(bench, bench.prepare(), "setup")
    assert "bench" not in heard(wire, "setup")[0].args


def test_a_scene_of_another_bench_names_it_even_without_a_layout(bench, wire):
    bench.scene.bench = "sorting"
    bench.scene.save()
    bench.scene.positions.update(bench=None)
    row = give(bench, bench.prepare(seed=42), "setup")
    laid = {"id": str(row.pk), "seed": 42, "positions": None, "of": "sorting"}
    laid["schema_digest"] = load_schema("sorting").digest
    assert heard(wire, "setup")[0].args["bench"] == laid


def test_every_set_up_lays_the_bench_anew(bench, wire):
    trial = bench.prepare()
    first, second = give(bench, trial, "setup"), give(bench, trial, "setup")
    assert first.args["bench"]["id"] != second.args["bench"]["id"]
    assert first.args["bench"]["seed"] == second.args["bench"]["seed"]


def test_an_accepted_run_begins_the_trial_and_its_episode(bench, wire):
    trial = bench.prepare()
    give(bench, trial, "setup")
    row = give(bench, trial, "run")
    args = heard(wire, "run")[0].args
    assert (args["operator"], args["duration_s"], args["mode"]) == ("ann", 40, "continuous")
    assert args["trial"]["uuid"] == str(trial.uuid)
    assert {"checkpoint", "scene", "position", "number", "attempt", "evaluation", "version"} <= set(
        args["trial"]
    )
    assert (trial.status, trial.run, trial.episode_id) == ("running", row.pk, wire.episode)
    assert (trial.episode.checkpoint, trial.episode.operator) == ("pi0-block", "ann")
    assert trial.started_at is not None


def test_answer_and_event_in_either_order_begin_it_once(bench, wire):
    trial = bench.prepare()
    give(bench, trial, "setup")
    row = give(bench, trial, "run")
    began = trial.started_at
    bench.event("command", "run", 50.0, uuid=str(row.pk), **{"from": "ready"}, to="running")
    trial.refresh_from_db()
    assert (trial.status, trial.run_event, trial.started_at) == ("running", 1, began)


def test_the_same_uuid_again_gets_the_first_answer_and_begins_nothing(bench, wire):
    trial = bench.prepare()
    give(bench, trial, "setup")
    uuid = uuid4()
    first = give(bench, trial, "run", uuid=uuid)
    again = give(bench, trial, "run", uuid=str(uuid))
    assert (again.pk, again.status) == (first.pk, "accepted")
    assert len(heard(wire, "run")) == 1
    assert trial.status == "running"


@pytest.mark.parametrize("word", ["refused", "failed"])
def test_a_run_that_is_not_accepted_leaves_the_trial_prepared(bench, wire, word):
    trial = bench.prepare()
    give(bench, trial, "setup")
    wire.status_word, wire.reason = word, "run is not allowed while setting_up"
    row = give(bench, trial, "run")
    assert (row.status, row.reason) == (word, "run is not allowed while setting_up")
    assert (trial.status, trial.episode) == ("prepared", None)


def test_a_run_whose_answer_is_lost_leaves_the_trial_to_its_event(bench, wire):
    trial = bench.prepare()
    give(bench, trial, "setup")
    wire.status = partial(dict, wire.snapshot)
    wire.fault = NoAnswer("bench-1 has not answered run in time")
    row = give(bench, trial, "run")
    assert (row.status, trial.status) == ("unknown", "prepared")
    bench.event("command", "run", 50.0, uuid=str(row.pk), **{"from": "ready"}, to="running")
    trial.refresh_from_db()
    assert trial.status == "running"


def test_nothing_is_run_that_was_not_set_up(bench, wire):
    with pytest.raises(Conflict, match="press Set up, then Run"):
        give(bench, bench.prepare(), "run")
    assert not wire.heard
    assert not Command.objects.exists()


def test_a_set_up_that_was_refused_is_none(bench, wire):
    trial = bench.prepare()
    wire.status_word = "refused"
    give(bench, trial, "setup")
    with pytest.raises(Conflict, match="not set up"):
        give(bench, trial, "run")


def test_nothing_is_run_after_the_station_was_set_up_for_something_else(bench, wire):
    trial = bench.prepare()
    give(bench, trial, "setup")
    services.abandon_trial(user=bench.operator, trial=trial)
    other = bench.prepare(checkpoint=Checkpoint.objects.create(name="other"))
    give(bench, other, "setup")
    services.abandon_trial(user=bench.operator, trial=other)
    third = bench.prepare()
    Trial.objects.filter(pk=third.pk).update(setup=trial.setup)
    with pytest.raises(Conflict, match="set up for something else"):
        give(bench, third, "run")


@pytest.mark.parametrize("told", [{}, {"checkpoint": {}}, {"checkpoint": {"id": 999, "name": "other"}}])
def test_nothing_is_run_after_a_terminal_set_the_station_up_for_something_else(bench, wire, told):
    trial = bench.prepare()
    give(bench, trial, "setup")
    wire.snapshot = told
    with pytest.raises(Conflict, match="by someone else, not for pi0-block: press Set up again"):
        give(bench, trial, "run")
    assert not heard(wire, "run")


def test_the_set_up_of_another_trial_is_not_that_of_this_one(bench, wire):
    trial = bench.prepare()
    uuid = give(bench, trial, "setup").pk
    services.abandon_trial(user=bench.operator, trial=trial)
    other = bench.prepare(checkpoint=Checkpoint.objects.create(name="other"))
    with pytest.raises(Conflict, match=f"not for trial {other.pk}"):
        give(bench, other, "setup", uuid=uuid)
    with pytest.raises(Conflict, match="is not set up"):
        give(bench, other, "run")


def test_the_run_of_another_trial_is_not_that_of_this_one(bench, wire):
    trial = bench.prepare()
    give(bench, trial, "setup")
    uuid = give(bench, trial, "run").pk
    Trial.objects.filter(pk=trial.pk).update(status="ended")
    voids.void_trial(user=bench.operator, trial=trial, reason="a person in the way")
    other = bench.prepare()
    with pytest.raises(Conflict, match=f"not for trial {other.pk}"):
        give(bench, other, "run", uuid=uuid)
    assert (Trial.objects.get(pk=other.pk).status, len(heard(wire, "run"))) == ("prepared", 1)


def test_the_same_set_up_again_gets_the_first_answer(bench, wire):
    trial = bench.prepare()
    first = give(bench, trial, "setup")
    Checkpoint.objects.update(policy={"url": "ws://127.0.0.1:9000"})
    trial.refresh_from_db()
    assert give(bench, trial, "setup", uuid=first.pk).pk == first.pk
    assert len(heard(wire, "setup")) == 1


@pytest.mark.parametrize("kind", ["setup", "run"])
def test_a_checkpoint_that_was_switched_off_is_run_no_more(bench, wire, kind):
    trial = bench.prepare()
    give(bench, trial, "setup")
    Checkpoint.objects.update(active=False)
    trial = Trial.objects.get(pk=trial.pk)
    with pytest.raises(Conflict, match="was switched off since"):
        give(bench, trial, kind)
    assert not heard(wire, "run")


@pytest.mark.parametrize("kind", ["setup", "run"])
@pytest.mark.parametrize("status", ["running", "paused", "ended", "scored", "interrupted"])
def test_what_is_not_prepared_is_neither_set_up_nor_run(bench, wire, kind, status):
    trial = bench.prepare()
    Trial.objects.filter(pk=trial.pk).update(status=status)
    with pytest.raises(Conflict, match=f"trial {trial.pk} is"):
        give(bench, trial, kind)
    assert not wire.heard


def test_other_commands_pass_with_their_own_arguments(bench, wire):
    trial = bench.prepare()
    assert give(bench, trial, "halt").status == "accepted"
    assert give(bench, trial, "resume", args={}).status == "accepted"
    assert [command.kind for command in wire.heard] == ["halt", "resume"]


def test_a_viewer_commands_nothing(bench, wire):
    with pytest.raises(NotAllowed):
        give(bench, bench.prepare(), "setup", user=builders.user("vic", "viewer"))
    assert not wire.heard


def test_a_uuid_that_is_none_is_refused(bench, wire):
    with pytest.raises(EvaError, match="must be a UUID"):
        give(bench, bench.prepare(), "setup", uuid="1234")
