"""Requests to a runtime: answered, not answered, not sent."""

from __future__ import annotations

import threading
import time
from uuid import uuid4

import pytest
from django.conf import settings

from evaweb.core.errors import NotFound, StationGone
from evaweb.stations.runtime_client import NoAnswer, connection_to
from runtime.ipc.messages import Command
from runtime.ipc.session_state import SessionState
from tests.evaweb.stand_in import old_snapshot


def test_status_is_the_snapshot_as_json_may_carry_it(runtime):
    status = connection_to(runtime.name).status()
    assert status["station"] == runtime.name
    assert status["latency"] is None


def test_a_station_that_was_started_before_an_upgrade_says_what_its_state_means(runtime, monkeypatch):
    old_snapshot(runtime, monkeypatch)
    runtime.ready()
    assert connection_to(runtime.name).status()["state_is"] == SessionState.READY.meaning_dict()


def test_a_station_that_was_never_started_is_not_asked():
    with pytest.raises(StationGone, match="nowhere is not running: its runtime has to be started"):
        connection_to("nowhere").status()


@pytest.mark.parametrize("name", ["../etc", "a/b", "", ".hidden", "x" * 64])
def test_what_is_no_name_never_reaches_the_disk(name):
    with pytest.raises(NotFound, match="make a name"):
        connection_to(name)


def test_no_answer_is_an_unknown_outcome(runtime):
    connection_to(runtime.name).status()
    runtime.mute = True
    with pytest.raises(NoAnswer, match="has not answered stop in time: outcome unknown, look at the robot"):
        connection_to(runtime.name).request(Command(str(uuid4()), "stop"), timeout=0.2)


def test_a_late_answer_is_never_taken_for_anothers(runtime):
    wire = connection_to(runtime.name)
    runtime.mute = True
    with pytest.raises(NoAnswer):
        wire.status(timeout=0.1)
    runtime.mute = False
    asked = str(uuid4())
    assert wire.request(Command(asked, "status")).uuid == asked


def test_a_restarted_runtime_is_found_at_its_new_address(runtime):
    wire = connection_to(runtime.name)
    before = wire.status()["boot"]
    runtime.end()
    runtime.boot_up()
    assert wire.status()["boot"] == runtime.boot != before


def test_a_command_that_expires_is_void_when_nobody_waits_for_it_any_more(runtime):
    runtime.ready()
    command = Command(str(uuid4()), "run", boot=runtime.boot, role="operator")
    connection_to(runtime.name).request(command, timeout=0.5, expires=True)
    (arrived,) = runtime.commands
    assert time.monotonic() < arrived.valid_until < time.monotonic() + 0.6


def test_a_station_whose_clock_is_unknown_is_not_sent_what_expires(runtime):
    runtime.mute = True
    with pytest.raises(StationGone, match="does not answer: run was not sent") as caught:
        connection_to(runtime.name).request(Command(str(uuid4()), "run"), timeout=0.2, expires=True)
    assert not isinstance(caught.value, NoAnswer)


def test_what_is_urgent_does_not_wait_behind_what_hangs(runtime):
    wire = connection_to(runtime.name)
    wire._lock.acquire()  # somebody is waiting for an answer
    try:
        assert (
            wire.request_urgent(Command(str(uuid4()), "status"), "coordinator", "commands", 2.0).status
            == "done"
        )
        with pytest.raises(StationGone, match="does not answer: status was not sent"):
            wire.status(timeout=0.05)
    finally:
        wire._lock.release()


def test_what_is_urgent_follows_its_socket_to_another_place(runtime):
    """The folder of a session goes, and the station listens elsewhere a second later."""
    wire, nowhere = connection_to(runtime.name), "ipc:///tmp/nobody-listens-here"
    there = wire.endpoints.read("guard")
    wire.endpoints.write("guard", {"estop": nowhere})
    listening = threading.Thread(target=lambda: (time.sleep(0.5), wire.endpoints.write("guard", there)))
    listening.start()
    press = Command(str(uuid4()), "estop", {"why": "test"})
    assert wire.request_urgent(press, "guard", "estop", 30.0).uuid == press.uuid
    listening.join()
    assert [command.uuid for command in runtime.pressed] == [press.uuid]


def test_threads_share_a_wire_and_each_gets_its_own_answer(runtime):
    wire, wrong = connection_to(runtime.name), []

    def ask():
        for _ in range(20):
            mine = str(uuid4())
            if wire.request(Command(mine, "status")).uuid != mine:
                wrong.append(mine)

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_an_endpoint_file_that_names_no_socket_means_not_running(runtime):
    folder = settings.DATA_DIR / "stations" / runtime.name / "endpoints"
    (folder / "coordinator.json").write_text("{}")
    with pytest.raises(StationGone, match="is not running"):
        connection_to(runtime.name).status()
