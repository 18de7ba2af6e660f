"""An operator names what administrators wrote: whatever table is tried over REST, no station hears of it."""

import json
from uuid import uuid4

import pytest
from django.test import Client

from evaweb.accounts.roles import Role, set_role
from evaweb.stations.models import Command
from evaweb.trials.tables import _kinds
from runtime.core.bounded_documents import MAX_DEPTH
from tests.evaweb.api.test_stations import command

CANARY = "EVA_SECRET_KEY"
TUNNEL = ("identity_file", "known_hosts_file", "ssh_config", "host", "user", "jump")


def tables():
    """Every key of every kind of policy, each with a canary; what is in a tunnel, too."""
    for kind, config in sorted(_kinds().items()):
        yield {"kind": kind}
        yield from ({"kind": kind, key: CANARY} for key in config.model_fields if key != "kind")
        yield from ({"kind": kind, "tunnel": {"host": "h", key: f"/{CANARY}"}} for key in TUNNEL)


def test_no_key_of_any_policy_is_taken_from_an_operator(rest, bench, wire):
    tried = list(tables())
    assert len(tried) > 150
    for table in tried:
        status, answer = command(rest, "setup", args={"policy": table})
        assert (status, "tables are for administrators" in answer["error"]) == (403, True), table
    assert not wire.heard
    assert not Command.objects.exists()


@pytest.mark.parametrize("kind", ["setup", "run", "tune", "home", "move"])
@pytest.mark.parametrize("key", ["policy", "checkpoint"])
def test_neither_is_who_answers_said_by_the_operator(rest, bench, wire, kind, key):
    assert command(rest, kind, args={key: {}})[0] == 403
    assert not wire.heard


@pytest.mark.parametrize("args", [{"policy": {}}, {"checkpoint": {"id": 7}}, {"policy": []}])
def test_what_goes_with_a_checkpoint_or_a_replay_replaces_nothing_of_it(rest, bench, wire, args):
    assert command(rest, "setup", checkpoint="pi0-block", args=args)[0] == 400
    assert command(rest, "setup", replay={"episode": "cups:0"}, args=args)[0] in (403, 404, 409)
    assert not wire.heard


def test_the_station_is_told_the_role_and_what_an_administrator_wrote(rest, bench, wire):
    assert command(rest, "setup", checkpoint="pi0-block")[0] == 200
    assert command(rest, "home")[0] == 200
    told = [(heard.role, sorted(heard.vouched)) for heard in wire.heard]
    assert told == [("operator", ["checkpoint", "policy"]), ("operator", [])]


def test_an_administrator_may_give_a_table_and_the_station_sees_to_what_it_names(rest, bench, wire):
    set_role(user=bench.operator, role=Role.ADMIN)
    assert command(rest, "setup", args={"policy": {"kind": "mock"}})[0] == 200
    assert [(heard.role, heard.vouched) for heard in wire.heard] == [("admin", [])]


@pytest.mark.parametrize(
    "episode", ["/etc", "../../etc:0", "stations/bench-1:0", "cups", "x" * 200, "\x00:1"]
)
def test_a_replay_is_named_and_never_a_path(rest, bench, wire, episode):
    assert command(rest, "setup", replay={"episode": episode})[0] in (400, 404)
    assert not wire.heard


def deep(rest, address, body):
    how = {"content_type": "application/json", "headers": rest._headers()}
    answer = Client().post(f"/api/v1/{address}", body, **how)
    return answer.status_code, answer.json()


def test_a_deep_body_is_refused_with_the_bound(rest, bench, wire):
    nested = (
        json.dumps({"uuid": str(uuid4()), "kind": "home", "page": "p"})[:-1] + ', "args": ' + '{"a":' * 5000
    )
    status, answer = deep(rest, "stations/bench-1/commands", nested)
    assert (status, f"allowed: at most {MAX_DEPTH}" in answer["error"]) == (400, True)
    assert not wire.heard


@pytest.mark.parametrize("body", ["[" * 20_000, "no json", json.dumps({"why": "[" * 300})])
def test_whatever_a_press_of_the_e_stop_says_it_is_a_press(rest, bench, wire, body):
    assert deep(rest, "stations/bench-1/estop", body)[0] == 200
    assert [heard.kind for heard in wire.heard] == ["estop"]
