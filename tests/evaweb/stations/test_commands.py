"""Commands: one row each, with what became of it."""

from __future__ import annotations

from datetime import timedelta
from uuid import uuid4

import pytest
from django.db import OperationalError
from django.utils import timezone

from evaweb.core.errors import Conflict, EvaError, NotAllowed
from evaweb.stations import commands, leases, stops
from evaweb.stations.commands import NotSent, issue_command, resolve_unknown_outcome
from evaweb.stations.models import Command, CommandStatus, Station
from evaweb.stations.stops import HARDWARE_STOP
from runtime.processes.coordinator.session.transitions import COMMANDS, STOPPING, GuardFacts
from tests.processes import PATIENCE_S

pytestmark = pytest.mark.django_db


@pytest.fixture
def held(live, runtime, ann):
    """The station is ready and ann's page has it; what her page sends along with each command."""
    runtime.ready()
    lease = leases.claim(user=ann, station=live, page="p1")
    return {"user": ann, "station": live, "page": "p1", "epoch": lease.epoch}


def seen(runtime):
    return {"boot": runtime.boot, "sequence": runtime.session.sequence}


def test_the_kinds_are_those_of_the_runtime():
    assert set(commands.KINDS) == {*COMMANDS, "estop"}
    assert commands.STOPPING == STOPPING


def test_an_accepted_command_is_a_row_with_its_answer(held, runtime):
    row = issue_command(kind="run", args={"operator": "ann"}, **held, **seen(runtime))
    found = Command.objects.get(pk=row.pk)
    assert (found.status, found.reason) == (CommandStatus.ACCEPTED, "")
    assert "stop" in found.allowed
    assert found.holder == "web:ann:p1"
    assert found.answered_at >= found.issued_at
    assert [(c.kind, c.args, c.user) for c in runtime.commands] == [("run", {"operator": "ann"}, "ann")]


@pytest.mark.parametrize(
    ("kind", "args", "situation"),
    [
        ("tune", {"strategy": {"kind": "sync"}, "task": "wave"}, GuardFacts()),
        ("step", {}, GuardFacts(mode="step")),
        ("commit", {}, GuardFacts(mode="preview", has_proposal=True)),
        ("cancel", {}, GuardFacts(mode="manual")),
        ("move", {"joints": [0.1] * 14, "speed": 0.5}, GuardFacts(mode="manual")),
        ("gripper", {"arm": "left_arm", "action": "lock"}, GuardFacts()),
        ("approach", {}, GuardFacts(mode="preview", has_proposal=True)),
    ],
)
def test_what_a_run_by_hand_is_steered_with_arrives_with_its_arguments(held, runtime, kind, args, situation):
    issue_command(kind="run", args={"mode": situation.mode or "continuous"}, **held, **seen(runtime))
    runtime.situated(situation)
    row = issue_command(kind=kind, args=args, **held, **seen(runtime))
    assert (row.status, row.reason) == (CommandStatus.ACCEPTED, "")
    assert [(c.kind, c.args) for c in runtime.commands[1:]] == [(kind, args)]


@pytest.mark.parametrize(("kind", "args"), [("tune", {"task": "x"}), ("gripper", {"action": "open"})])
def test_nobody_changes_what_a_trial_measures(held, runtime, kind, args):
    issue_command(kind="run", **held, **seen(runtime))
    runtime.situated(GuardFacts(mode="continuous", trial=True))
    row = issue_command(kind=kind, args=args, **held, **seen(runtime))
    assert row.status == CommandStatus.REFUSED
    assert "the open run is one of a trial" in row.reason
    assert kind not in row.allowed


def test_the_same_uuid_twice_is_one_command(held, runtime):
    uuid = uuid4()
    first = issue_command(kind="run", uuid=uuid, **held, **seen(runtime))
    again = issue_command(kind="run", uuid=str(uuid), **held, **seen(runtime))
    assert (again.pk, again.status) == (first.pk, CommandStatus.ACCEPTED)
    assert len(runtime.commands) == 1
    assert Command.objects.count() == 1


@pytest.mark.parametrize("value", [10**40, "\ud800"], ids=["too large", "no character"])
def test_what_cannot_be_sent_is_refused_before_it_is_a_row(held, runtime, value):
    with pytest.raises(EvaError, match="run cannot be sent with these args"):
        issue_command(kind="run", args={"operator": value}, **held, **seen(runtime))
    assert not Command.objects.exists()


def test_a_press_is_not_lost_for_its_words(held, runtime):
    row = issue_command(kind="estop", args={"why": "\ud800\x00" + "x" * 999}, **held)
    assert row.status == CommandStatus.DONE
    assert runtime.pressed[0].args["why"].startswith("?x")
    answer = stops.send_estop(station=held["station"].name, username="ann", why="\udfff", uuid=uuid4())
    assert answer.status == CommandStatus.DONE


def test_a_uuid_of_another_command_is_refused(held, runtime):
    uuid = issue_command(kind="run", **held, **seen(runtime)).uuid
    with pytest.raises(Conflict, match="that of another command"):
        issue_command(kind="home", uuid=uuid, **held)


def test_what_was_decided_before_a_restart_is_shown_as_refused_with_the_reason(held, runtime):
    row = issue_command(kind="run", **held, boot="another", sequence=runtime.session.sequence)
    assert row.status == CommandStatus.REFUSED
    assert "decided before the runtime was restarted" in row.reason
    assert "run" in row.allowed


def test_of_two_who_press_run_one_is_refused_with_who_has_the_station(held, runtime, bob):
    now = seen(runtime)
    mine = issue_command(kind="run", **held, **now)
    theirs = issue_command(
        user=bob, station=held["station"], kind="run", page="p2", **now, epoch=held["epoch"]
    )
    assert (mine.status, theirs.status) == (CommandStatus.ACCEPTED, CommandStatus.REFUSED)
    assert runtime.session.state == "running"


def test_the_second_press_of_the_same_person_is_stale(held, runtime):
    now = seen(runtime)
    assert issue_command(kind="run", **held, **now).status == CommandStatus.ACCEPTED
    second = issue_command(kind="run", **held, **now)
    assert second.status == CommandStatus.REFUSED
    assert "the state has changed since it was decided" in second.reason


def test_no_answer_is_an_unknown_outcome(held, runtime, settings):
    settings.EVA_COMMAND_TIMEOUT_S = 0.3
    runtime.swallows.add("run")
    row = issue_command(kind="run", **held, **seen(runtime))
    assert row.status == CommandStatus.UNKNOWN
    assert "outcome unknown, look at the robot" in row.reason


def test_a_station_that_is_not_running_was_sent_nothing(ann):
    station = Station.objects.create(name="never", robot="agilex_piper")
    row = issue_command(user=ann, station=station, kind="run")
    assert row.status == CommandStatus.FAILED
    assert row.reason == "never is not running: its runtime has to be started"


@pytest.mark.parametrize("kind", ["run", "stop", "halt", "release"])
def test_a_viewer_commands_nothing(live, vera, runtime, kind):
    with pytest.raises(NotAllowed, match="vera is a viewer; this needs an operator"):
        issue_command(user=vera, station=live, kind=kind)
    assert runtime.commands == []
    assert not Command.objects.exists()


def test_a_viewer_presses_the_estop(live, vera, runtime):
    row = issue_command(user=vera, station=live, kind="estop", args={"why": "smoke"})
    assert Command.objects.get(pk=row.pk).status == CommandStatus.DONE
    assert [(c.user, c.args) for c in runtime.pressed] == [("vera", {"why": "smoke"})]


@pytest.mark.parametrize(("answered", "how"), [("mine", "anew"), ("another's", "already")])
def test_a_press_that_shared_anothers_answer_does_not_say_that_it_latched(
    live, ann, monkeypatch, answered, how
):
    noted, uuid = [], uuid4()
    monkeypatch.setattr(commands.notes, "record", noted.append)
    said = {"latched": "anew", "carried_out_at": 10.0}
    answer = stops.Answer(CommandStatus.DONE, data=said, uuid=str(uuid) if answered == "mine" else "x")
    at = timezone.now() - timedelta(seconds=3)
    commands.record_estop(user=ann, station=live, why="smoke", uuid=uuid, answer=answer, at=at)
    (row,) = noted
    assert (row.data["latched"], row.data["carried_out_at"]) == (how, 10.0)
    assert row.issued_at == at, "when it was pressed, not when it was noted"


def test_a_kind_that_there_is_not_names_those_that_there_are(live, ann):
    with pytest.raises(EvaError, match="command 'jump' is unknown; allowed: setup, run, stop"):
        issue_command(user=ann, station=live, kind="jump")


def test_a_lease_is_no_command(live, ann):
    with pytest.raises(EvaError, match="'lease_claim' is unknown"):
        issue_command(user=ann, station=live, kind="lease_claim")


def test_stopping_waits_for_no_database(held, runtime, monkeypatch):
    issue_command(kind="run", **held, **seen(runtime))

    def locked(*arguments, **named):
        raise OperationalError("database is locked")

    monkeypatch.setattr(Command, "save", locked)
    row = issue_command(kind="stop", **held)
    assert row.status == CommandStatus.ACCEPTED
    assert runtime.session.state == "ready"
    assert not Command.objects.filter(kind="stop").exists()


def test_a_command_that_cannot_be_written_down_is_not_sent(held, runtime, monkeypatch):
    def locked(*arguments, **named):
        raise OperationalError("database is locked")

    monkeypatch.setattr(Command, "save", locked)
    with pytest.raises(NotSent, match="run was not sent: the database does not take it now"):
        issue_command(kind="run", **held, **seen(runtime))
    assert runtime.commands == []


def test_a_command_that_waited_long_for_the_database_is_not_sent(held, runtime, settings):
    settings.EVA_COMMAND_TIMEOUT_S = -1.0  # longer than any
    row = issue_command(kind="run", **held, **seen(runtime))
    assert row.status == CommandStatus.FAILED
    assert "not sent: the database took" in row.reason
    assert runtime.commands == []


def test_an_answer_that_is_not_written_down_is_given_all_the_same_and_found_later(held, runtime, monkeypatch):
    save = Command.save

    def locked_later(self, *arguments, **named):
        if named.get("update_fields"):
            raise OperationalError("database is locked")
        save(self, *arguments, **named)

    monkeypatch.setattr(Command, "save", locked_later)
    row = issue_command(kind="run", **held, **seen(runtime))
    assert row.status == CommandStatus.ACCEPTED
    assert Command.objects.get(pk=row.pk).status == CommandStatus.PRESSED
    monkeypatch.setattr(Command, "save", save)
    assert _settled_later(row).status == CommandStatus.ACCEPTED


def _settled_later(row):
    Command.objects.filter(pk=row.pk).update(issued_at=row.issued_at - timedelta(seconds=2 * PATIENCE_S))
    (lost,) = commands.unresolved_commands(station=row.station)
    resolve_unknown_outcome(row=lost)
    return Command.objects.get(pk=row.pk)


def test_a_lost_answer_is_found_by_asking_again(held, runtime):
    row = issue_command(kind="run", **held, **seen(runtime))
    Command.objects.filter(pk=row.pk).update(status=CommandStatus.UNKNOWN)
    assert _settled_later(row).status == CommandStatus.ACCEPTED
    assert runtime.session.state == "running"


def test_a_command_that_never_arrived_comes_too_late_for_ever(held, runtime, settings):
    runtime.swallows.add("run")
    settings.EVA_COMMAND_TIMEOUT_S = 0.3
    row = issue_command(kind="run", **held, **seen(runtime))
    settings.EVA_COMMAND_TIMEOUT_S = PATIENCE_S
    runtime.swallows.clear()
    settled = _settled_later(row)
    assert settled.status == CommandStatus.REFUSED
    assert "stale" in settled.reason
    assert runtime.session.state == "ready"


def test_a_young_command_is_not_asked_about(held, runtime):
    row = issue_command(kind="run", **held, **seen(runtime))
    row.status = CommandStatus.UNKNOWN
    assert resolve_unknown_outcome(row=row).status == CommandStatus.UNKNOWN
    assert len(runtime.commands) == 1


def test_a_stop_whose_outcome_is_unknown_is_never_given_again(held, runtime, settings):
    settings.EVA_COMMAND_TIMEOUT_S = 0.3
    runtime.mute = True
    row = issue_command(kind="stop", **held)
    runtime.mute = False
    assert row.status == CommandStatus.UNKNOWN
    assert "the e-stop goes another way" in row.reason
    Command.objects.filter(pk=row.pk).update(issued_at=row.issued_at - timedelta(seconds=2 * PATIENCE_S))
    assert commands.unresolved_commands(station=row.station) == []


def test_an_estop_that_is_not_obeyed_says_use_the_hardware_stop(live, vera, runtime):
    runtime.guard_says = "failed"
    assert issue_command(user=vera, station=live, kind="estop").status == CommandStatus.FAILED
    runtime.guard_says = "refused"
    row = issue_command(user=vera, station=live, kind="estop")
    assert row.status == CommandStatus.FAILED
    assert row.reason.startswith(HARDWARE_STOP)


def test_what_is_no_uuid_is_refused(live, ann):
    with pytest.raises(EvaError, match="uuid 'seven': must be a UUID such as"):
        issue_command(user=ann, station=live, kind="run", uuid="seven")
