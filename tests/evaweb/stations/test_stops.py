"""None of these may touch the database: without a mark, access to it is an error."""

import time
from uuid import uuid4

import pytest

from evaweb.stations import stops
from evaweb.stations.lease_holders import with_display_names
from evaweb.stations.models import CommandStatus
from evaweb.stations.runtime_client import StationConnection
from evaweb.stations.stops import HARDWARE_STOP
from runtime.ipc.messages import Ack


def test_an_estop_without_answer_says_use_the_hardware_stop(runtime, settings):
    settings.EVA_COMMAND_TIMEOUT_S = 0.3
    runtime.mute = True
    answer = stops.send_estop(station=runtime.name, username="ann", why="smoke", uuid=uuid4())
    assert answer.status == CommandStatus.UNKNOWN
    assert answer.reason.startswith(HARDWARE_STOP)


def test_an_estop_where_nothing_runs_says_use_the_hardware_stop():
    answer = stops.send_estop(station="nowhere", username="ann", why="smoke", uuid=uuid4())
    assert answer.status == CommandStatus.FAILED
    assert answer.reason.startswith(HARDWARE_STOP)


def test_another_stations_answer_is_not_taken_for_ours(runtime, monkeypatch):
    answered = Ack("u", "done", "every tick now sends the measured position", data={"station": "the-other"})
    monkeypatch.setattr(StationConnection, "request_urgent", lambda *args: answered)
    answer = stops.send_estop(station=runtime.name, username="ann", why="smoke", uuid=uuid4())
    assert answer.status == CommandStatus.FAILED
    assert answer.reason.startswith(
        f"{HARDWARE_STOP}: the station the-other answered instead of {runtime.name}"
    )


def test_an_estop_is_obeyed(runtime):
    answer = stops.send_estop(station=runtime.name, username="ann", why="smoke", uuid=uuid4())
    assert answer.status == CommandStatus.DONE


@pytest.mark.parametrize("kind", ["stop", "halt"])
def test_a_refused_stop_names_who_has_the_lease(runtime, kind):
    runtime.ready()
    runtime.do(lambda: runtime.lease.claim("web:ann:p1", 3, time.monotonic()))
    order = stops.stop_command(kind=kind, username="bob", page="p2", epoch=1, uuid=uuid4())
    answer = stops.request_stop(order, runtime.name).result()
    assert (answer.status, answer.reason) == (CommandStatus.REFUSED, "ann holds the lease")


def test_a_reason_names_people_and_leaves_terminals_as_they_are():
    assert (
        with_display_names("web:ann:p-1 holds the lease, eve@bench asks")
        == "ann holds the lease, eve@bench asks"
    )
