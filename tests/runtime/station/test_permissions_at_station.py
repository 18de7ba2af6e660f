"""Whole stations and a server that listens for a secret: who makes them send it, and who does not."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

from runtime.ipc.messages import Ack, Command
from runtime.ipc.session_state import SessionState
from tests.processes import PATIENCE_S
from tests.runtime.lockstep_station import Station, stubbed

CANARY = "the canary sings"


@pytest.fixture
def server() -> Iterator[socket.socket]:
    """Listens, and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(0)
        yield listening


@pytest.fixture
def station(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Station]:
    monkeypatch.setenv("LAB_SECRET", CANARY)
    made = Station(stubbed(tmp_path, real="openpi"))
    made.until(lambda: made.state is SessionState.IDLE, 30.0, "a state to set up from")
    yield made
    made.close()


def command(station: Station, policy: dict[str, Any], role: str, vouched: tuple[str, ...] = ()) -> Command:
    main = station.coordinator
    held = main.lease.current(main.client_clock.now())
    assert held is not None
    given = {"holder": held.holder, "epoch": held.epoch, "boot": main.boot, "sequence": main.session.sequence}
    return Command(str(uuid4()), "setup", {"policy": policy}, **given, role=role, vouched=list(vouched))


def asked(
    station: Station, server: socket.socket, role: str, vouched: tuple[str, ...] = (), **table: Any
) -> Ack:
    policy = {"kind": "openpi", "url": f"ws://127.0.0.1:{server.getsockname()[1]}", "connect_deadline": 0.2}
    return station.coordinator.handle(command(station, policy | table, role, vouched))


def heard(server: socket.socket) -> bytes:
    """What the first who connected said; b"" where nobody did."""
    try:
        connection, _ = server.accept()
    except BlockingIOError:
        return b""
    with connection:
        connection.settimeout(PATIENCE_S)
        return connection.recv(4096)


@pytest.mark.parametrize(
    ("role", "vouched", "table"),
    [
        ("operator", (), {}),
        ("operator", (), {"api_key_env": "LAB_SECRET"}),
        ("viewer", (), {"api_key_env": "LAB_SECRET"}),
        ("operator", ("checkpoint",), {"api_key_env": "LAB_SECRET"}),
        ("operator", ("policy",), {"api_key_env": "LAB_SECRET"}),
        ("admin", (), {"api_key_env": "LAB_SECRET"}),
    ],
)
def test_nothing_is_sent_to_whoever_asks_for_a_secret(
    station: Station, server: socket.socket, role: str, vouched: tuple[str, ...], table: dict[str, Any]
) -> None:
    ack = asked(station, server, role, vouched, **table)
    assert ack.status == "refused"
    assert ("tables are for administrators" in ack.reason) or ("a table from the web may name" in ack.reason)
    assert CANARY not in ack.reason
    station.go(5)
    assert station.state is SessionState.IDLE
    assert heard(server) == b""


@pytest.mark.parametrize(("role", "vouched"), [("operator", ("policy",)), ("admin", ()), ("local", ())])
def test_a_table_without_names_is_set_up_and_the_stations_own_account_may_name_what_it_has(
    station: Station, server: socket.socket, role: str, vouched: tuple[str, ...]
) -> None:
    table = {"api_key_env": "LAB_SECRET"} if role == "local" else {}
    assert asked(station, server, role, vouched, **table).status == "accepted"
    station.until(lambda: station.state is not SessionState.SETTING_UP, 60.0, "the end of the set-up")
    assert (CANARY.encode() in heard(server)) == (role == "local")


def test_a_command_that_was_answered_is_answered_alike_however_it_comes_again(
    station: Station,
) -> None:
    first = command(station, {"kind": "mock"}, "operator", ("policy",))
    assert station.coordinator.handle(first).status == "accepted"
    assert station.coordinator.handle(replace(first, vouched=[])).status == "accepted"
    assert station.coordinator.handle(replace(first, uuid=str(uuid4()), vouched=[])).status == "refused"
