import sqlite3
from uuid import uuid4

import pytest
from django.contrib.auth.models import User
from django.db import OperationalError, connection
from django.test import Client

from evaweb.api.tokens import create_token
from evaweb.core.errors import StationGone
from evaweb.stations import commands
from evaweb.stations.models import Command, Lease, Station
from evaweb.stations.runtime_client import NoAnswer
from evaweb.trials.models import Checkpoint, Trial
from runtime.processes.coordinator import operations
from tests.evaweb.api.conftest import Rest
from tests.evaweb.trials.builders import BOOT


def command(rest, kind, **given):
    body = {"uuid": str(uuid4()), "kind": kind, "page": "p1", "epoch": 1, "boot": BOOT, "sequence": 2}
    return rest.post("stations/bench-1/commands", **{**body, **given})


def test_a_station_is_shown_with_its_snapshot_or_why_there_is_none(rest, bench, wire):
    status, found = rest.get("stations/bench-1")
    assert (status, found["snapshot"]["state"], found["gone"], found["trial"]) == (200, "ready", "", None)
    trial = bench.prepare()
    wire.fault = StationGone("bench-1 is not running: its runtime has to be started")
    status, found = rest.get("stations/bench-1")
    assert (status, found["snapshot"], found["trial"]["id"]) == (200, None, trial.pk)
    assert "not running" in found["gone"]


def test_stations_are_listed_without_asking_them(rest, bench, wire):
    Station.objects.create(name="bench-9", robot="agilex_piper", active=False)
    assert [row["name"] for row in rest.get("stations")[1]] == ["bench-1"]
    assert len(rest.get("stations", inactive="true")[1]) == 2
    assert not wire.heard


def test_commands_answer_with_what_became_of_them(rest, bench, wire):
    status, answer = command(rest, "home")
    assert (status, answer["status"], answer["allowed"]) == (200, "accepted", ["stop"])
    wire.status_word, wire.reason = "refused", "home is not allowed while running"
    status, answer = command(rest, "home")
    assert (status, answer["status"], answer["reason"]) == (
        409,
        "refused",
        "home is not allowed while running",
    )
    wire.fault = NoAnswer("bench-1 has not answered home in time")
    status, answer = command(rest, "home")
    assert (status, answer["status"]) == (504, "unknown")


def test_a_refusal_has_the_id_that_the_station_gave_it(rest, bench, wire):
    wire.status_word, wire.reason = "refused", operations._FAMILY_STARTING(process="media")
    status, answer = command(rest, "resume")
    assert (status, answer["id"]) == (409, "operations.family_starting")
    assert answer["arguments"] == {"process": "media"}


def test_a_trial_goes_through_set_up_and_run(rest, bench, wire):
    trial = bench.prepare()
    status, refused = command(rest, "run", trial=trial.pk)
    assert (status, refused["error"]) == (
        409,
        f"trial {trial.pk} is not set up: press Set up, then Run",
    )
    assert command(rest, "setup", trial=trial.pk)[0] == 200
    status, answer = command(rest, "run", trial=trial.pk)
    assert (status, answer["data"]["episode"]) == (200, str(wire.episode))
    assert Trial.objects.get().status == "running"
    assert rest.get(f"episodes/{wire.episode}")[1]["trial"] == trial.pk


def test_a_set_up_without_a_trial_names_a_checkpoint_and_never_its_address(rest, bench, wire):
    status, _ = command(rest, "setup", checkpoint="pi0-block", args={"task": "wave"})
    assert status == 200
    assert wire.heard[0].args == {
        "task": "wave",
        "policy": {"url": "ws://127.0.0.1:8000"},
        "checkpoint": {"id": bench.checkpoint.pk, "name": "pi0-block"},
    }
    assert command(rest, "setup", checkpoint=bench.checkpoint.pk)[0] == 200


def test_a_checkpoint_that_cannot_be_set_up_is_refused_with_the_reason(rest, bench, wire):
    trial = bench.prepare()
    refused = [
        command(rest, "run", checkpoint="pi0-block"),
        command(rest, "setup", checkpoint="pi0-block", args={"policy": {"url": "ws://127.0.0.1:1"}}),
        command(rest, "setup", checkpoint="pi0-block", trial=trial.pk),
        command(rest, "setup", checkpoint="nothing"),
    ]
    Checkpoint.objects.update(active=False)
    refused.append(command(rest, "setup", checkpoint="pi0-block"))
    assert [status for status, _ in refused] == [400, 400, 400, 404, 409]
    sentences = ["run takes no checkpoint", "give one of them", "name one of them", "nothing", "switched off"]
    for (_, answer), sentence in zip(refused, sentences, strict=True):
        assert sentence in answer["error"]
    assert not wire.heard


def test_the_same_uuid_again_gets_the_first_answer(rest, bench, wire):
    uuid = str(uuid4())
    assert command(rest, "home", uuid=uuid) == command(rest, "home", uuid=uuid)
    assert len(wire.heard) == 1
    assert command(rest, "resume", uuid=uuid)[0] == 409


def test_a_trial_of_another_station_is_refused(rest, bench, wire):
    trial = bench.prepare()
    Station.objects.create(name="bench-2", robot="agilex_piper")
    body = {"uuid": str(uuid4()), "kind": "setup", "page": "p1", "trial": trial.pk}
    status, answer = rest.post("stations/bench-2/commands", **body)
    assert status == 400
    assert "is one of bench-1, not of bench-2" in answer["error"]
    assert not wire.heard


@pytest.mark.parametrize(
    "given", [{"uuid": "x"}, {"page": "a b"}, {"page": ""}, {"epoch": -1}, {"args": []}, {"sequence": 2**60}]
)
def test_malformed_commands_reach_no_station(rest, bench, wire, given):
    assert command(rest, "home", **given)[0] == 422
    assert not wire.heard


def test_a_viewer_commands_nothing_but_the_e_stop(viewer, bench, wire):
    status, answer = command(viewer, "home")
    assert status == 403
    assert "viewer" in answer["error"]
    assert not wire.heard
    status, answer = viewer.post("stations/bench-1/estop", why="it falls")
    assert (status, answer["status"]) == (200, "accepted")
    assert Command.objects.get().args == {"why": "it falls"}


def test_an_e_stop_that_nobody_confirms_says_what_to_do(rest, bench, wire):
    wire.fault = NoAnswer("bench-1 has not answered estop in time")
    status, answer = rest.post("stations/bench-1/estop")
    assert status == 504
    assert answer["reason"].startswith("USE THE HARDWARE STOP")


def test_an_e_stop_works_without_the_database(rest, bench, wire, monkeypatch):
    def locked(row):
        raise OperationalError("database is locked")

    monkeypatch.setattr(commands, "_stored_row", locked)
    monkeypatch.setattr(commands.unwritten, "start_writing", lambda: None)
    status, answer = rest.post("stations/bench-1/estop")
    assert (status, answer["status"]) == (200, "accepted")
    assert [given.kind for given in wire.heard] == ["estop"]


@pytest.fixture
def locked(transactional_db):
    """Somebody else writes and does not end."""
    if connection.vendor != "sqlite":
        pytest.skip("only SQLite is locked as a whole")
    other = sqlite3.connect(connection.settings_dict["NAME"], isolation_level=None)
    yield lambda what="BEGIN IMMEDIATE": other.execute(what)
    other.close()


@pytest.mark.parametrize("kind", ["estop", "stop"])
def test_who_stops_with_a_token_is_not_kept_by_a_locked_database(locked, bench, wire, kind):
    User.objects.update(is_superuser=True)
    rest = Rest(create_token(user=bench.operator, name="never used"))
    identity = str(uuid4())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(commands.unwritten, "start_writing", lambda: None)
        patch.setattr(commands.notes, "record", commands.unwritten.store)
        locked()
        if kind == "estop":
            answer = rest.post("stations/bench-1/estop", uuid=identity)
        else:
            answer = rest.post("stations/bench-1/commands", uuid=identity, kind="stop", page="p1", epoch=3)
    assert (answer[0], answer[1]["status"]) == (200, "accepted")
    assert [given.kind for given in wire.heard] == [kind]
    assert not Command.objects.exists()
    locked("ROLLBACK")
    assert commands.unwritten.write_all() is False
    assert (str(Command.objects.get().uuid), Command.objects.get().status) == (identity, "accepted")


def test_an_e_stop_is_written_down_later_where_the_database_does_not_say_which_station_it_was(
    rest, bench, wire, monkeypatch
):
    def away(*_, **__):
        raise OperationalError("the server closed the connection unexpectedly")

    with monkeypatch.context() as patch:
        patch.setattr(commands, "_stored_row", away)
        patch.setattr(commands.unwritten, "start_writing", lambda: None)
        status, answer = rest.post("stations/bench-1/estop", why="smoke")
    assert (status, answer["status"]) == (200, "accepted")
    commands.unwritten.write_all()
    row = Command.objects.get()
    assert (row.station, row.user, row.args) == (bench.station, bench.operator, {"why": "smoke"})


@pytest.mark.parametrize("body", ["", "null", "[]", '{"uuid": 5, "why": 7}', '{"why": "%s"}' % ("x" * 999)])
def test_a_press_is_not_refused_for_what_is_said_with_it(rest, bench, wire, body):
    answer = Client().post(
        "/api/v1/stations/bench-1/estop", body, content_type="application/json", headers=rest._headers()
    )
    assert answer.status_code == 200
    assert [given.kind for given in wire.heard] == ["estop"]
    assert len(wire.heard[0].args["why"]) <= 240


def test_a_run_for_a_trial_goes_by_the_trial(rest, bench, wire):
    trial = bench.prepare()
    status, answer = command(rest, "run", args={"trial": {"uuid": str(trial.uuid)}})
    assert status == 422
    assert "name it beside them" in answer["error"]
    assert not wire.heard


def test_the_lease_is_claimed_and_shown(rest, bench, wire):
    wire.snapshot = {"lease": {"holder": "", "epoch": 0}, "boot": BOOT}
    status, lease = rest.post("stations/bench-1/lease", action="claim", page="p1")
    assert (status, lease["user"], lease["holder"], lease["epoch"]) == (200, "ann", "web:ann:p1", 1)
    wire.snapshot = {"lease": {"holder": "web:ann:p1", "epoch": 1}, "boot": BOOT}
    assert rest.post("stations/bench-1/lease", action="give_up", page="p1")[1]["holder"] == ""
    assert Lease.objects.get().end_reason == "given up"


def test_ones_own_lease_is_moved_to_the_page_that_asks(rest, bench, wire):
    wire.snapshot = {"lease": {"holder": "web:ann:p1", "epoch": 4}, "boot": BOOT}
    status, lease = rest.post("stations/bench-1/lease", action="move", page="p2")
    assert (status, lease["holder"], lease["epoch"]) == (200, "web:ann:p2", 5)
    wire.snapshot = {"lease": {"holder": "web:bob:p7", "epoch": 6}, "boot": BOOT}
    status, answer = rest.post("stations/bench-1/lease", action="move", page="p2")
    assert status == 409
    assert "bob has" in answer["error"]


def test_a_viewer_asks_and_the_holder_declines_or_nobody_may(viewer, rest, bench, wire):
    wire.snapshot = {"lease": {"holder": "web:ann:p1", "epoch": 1}, "boot": BOOT}
    assert viewer.post("stations/bench-1/lease", action="request", page="p2")[0] == 403
    for action in ("hand_over", "decline"):
        status, answer = rest.post("stations/bench-1/lease", action=action, page="p1")
        assert status == 400
        assert "request is missing" in answer["error"]


def test_only_an_administrator_takes_a_station(rest, bench, wire):
    status, answer = rest.post("stations/bench-1/lease", action="take", page="p1", reason="x")
    assert status == 403
    assert "needs an admin" in answer["error"]
    assert rest.post("stations/bench-1/lease", action="steal", page="p1")[0] == 422
