"""A station elsewhere, as the programs of its lab find it."""

from __future__ import annotations

import time
from uuid import uuid4

import numpy as np
import pytest

from runtime.core.errors import TransportError
from runtime.ipc.bus import Endpoints
from runtime.ipc.messages import Command
from runtime.ipc.station_lock import StationLockedError, acquire
from runtime.link import key_files
from runtime.link.wire import RELEASE, Hello
from tests.processes import PATIENCE_S, eventually
from tests.runtime.link.linked import STATION, Robot, allowed


def command(kind, **fields):
    return Command(str(uuid4()), kind, **{"user": "ann", "holder": "web:ann:1", "role": "operator", **fields})


def test_a_command_of_the_web_is_carried_out_with_its_user_and_role(lab, linked):
    linked.station.ready()
    claimed = lab.ask(command("lease_claim", epoch=1))
    assert claimed.status == "accepted"
    told = lab.ask(command("run", epoch=1, boot=linked.station.boot, sequence=claimed.sequence))
    assert told.uuid == linked.station.commands[-1].uuid
    assert (linked.station.commands[-1].user, linked.station.commands[-1].role) == ("ann", "operator")


def test_a_press_reaches_the_guard_as_the_person_who_pressed(lab, linked):
    assert lab.press().status == "done"
    assert [(one.user, one.role) for one in linked.station.pressed] == [("ann", "operator")]


def test_a_program_of_the_labs_computer_stops_and_commands_nothing(lab, linked):
    refused = lab.ask(command("lease_claim", epoch=1, user="", holder="terminal:x"), sign=False)
    assert refused.status == "refused"
    assert "not signed by this lab's web" in refused.reason
    assert lab.press(sign=False).status == "done"
    (press,) = linked.station.pressed
    assert (press.user, press.role) == ("ann (unverified)", "unverified")
    assert lab.ask(command("stop", holder="terminal:x"), sign=False).uuid == linked.station.commands[-1].uuid
    assert linked.station.commands[-1].role == "unverified"


def test_streams_and_pictures_are_published_where_the_lab_looks(lab, linked):
    state = lab.hears("coordinator", "state", "state")["state"]
    assert state["boot"] == linked.station.boot
    joints = lab.hears("coordinator", "state", "joints")["joints"]
    np.testing.assert_array_equal(joints["measured"], np.full(14, 0.1, np.float32))
    pictures = lab.hears("media", "cameras", "camera/")
    assert pictures == {"camera/cam_high": b"\xff\xd8 a picture"}


def test_a_link_that_is_lost_takes_what_can_be_commanded_away_and_says_since_when(lab, linked):
    linked.hang_up()
    lab.lost()
    endpoints = Endpoints(lab.folder())
    with pytest.raises(TransportError):
        endpoints.read("coordinator")
    assert "link to its computer is lost" in endpoints.read("link")["why"]
    assert abs(float(endpoints.read("link")["since"]) - time.time()) < 60
    told = lab.press()
    assert told.status == "failed"
    assert told.reason.startswith("USE THE HARDWARE STOP: not sent, the link to bench-7 is lost")


def test_a_press_while_the_link_is_lost_goes_on_where_it_comes_back_soon(lab, linked):
    linked.hang_up()
    lab.lost()
    assert lab.press().status == "failed"
    linked.dial()
    eventually(lambda: linked.station.pressed, "the press")


def test_a_command_is_not_carried_out_after_the_link_came_back(lab, linked):
    """What the lab has sent and the station not read belongs to a connection that is gone."""
    linked.station.swallows = {"run"}
    lost = command("run", epoch=1)
    with pytest.raises(TransportError, match="outcome unknown"):
        lab.ask(lost, timeout=0.3)
    linked.hang_up()
    lab.lost()
    linked.station.swallows = set()
    linked.dial()
    lab.linked()
    assert lab.ask(command("status")).status == "done"
    assert linked.station.commands == []


def test_a_station_that_is_restarted_is_found_again(lab, linked):
    linked.station.end(tidy=True)
    lab.lost()
    assert "does not run there" in Endpoints(lab.folder()).read("link")["why"]
    linked.station.boot_up()
    lab.linked()
    assert lab.ask(command("status")).boot == linked.station.boot


def test_a_gate_that_is_restarted_is_dialled_again(lab, linked):
    port, second_port = lab.gate.port, lab.gate.second_port
    lab.end()
    assert "gate was ended" in Endpoints(lab.folder()).read("link")["why"]
    lab.begin(port, second_port)
    lab.linked()
    assert lab.press().status == "done"


def test_a_key_that_is_withdrawn_is_cut_off_and_let_in_no_more(lab, linked):
    lab.allowed.now = allowed()
    eventually(lambda: _said(Endpoints(lab.folder()), "withdrawn"), "the word")
    eventually(lambda: _is_free(lab.folder()), "the name, for another station")
    with pytest.raises(TransportError):
        Endpoints(lab.folder()).read("guard")


def _is_free(folder):
    try:
        acquire(folder).close()
    except StationLockedError:
        return False
    return True


@pytest.mark.exhaustive
def test_a_name_that_a_station_of_the_labs_computer_has_is_refused(lab, robot):
    with acquire(lab.folder()) as lock:
        robot.dial()
        eventually(lambda: _refusal(lab), "the refusal")
        assert "runs on the lab's own computer" in _refusal(lab)
        lock.close()
    lab.linked()


def _refusal(lab):
    remote = lab.gate._remotes.get(STATION)
    return remote.refusal if remote else ""


def test_a_station_cannot_claim_anothers_name(lab, linked, tmp_path, caplog):
    thief = Robot(tmp_path / "thief", lab, STATION)
    lab.allowed.now = allowed((linked.key, STATION), (thief.key, "bench-8"))
    try:
        thief.dial()
        eventually(lambda: "not known here with this key" in caplog.text, "the refusal")
        assert lab.press().status == "done"
        assert len({one.uuid for one in linked.station.pressed}) == 1
        assert thief.station.pressed == []
    finally:
        thief.end()


def test_releases_further_apart_are_refused_by_a_sentence_that_names_both(lab, robot, monkeypatch):
    monkeypatch.setattr("runtime.link.line.Hello", lambda release, *rest: Hello(release + 2, *rest))
    robot.dial()
    endpoints = Endpoints(lab.folder())
    why = eventually(lambda: _said(endpoints, "release"), "the refusal")
    assert f"the lab has release {RELEASE} of the link" in why
    assert f"the computer of {STATION} release {RELEASE + 2}" in why


def _said(endpoints, word):
    try:
        why = endpoints.read("link")["why"]
    except TransportError:
        return ""
    return why if word in why else ""


def test_an_unknown_key_is_let_in_for_nothing_and_its_computer_is_told(lab, robot, caplog):
    lab.allowed.now = allowed((key_files.KeyPair.from_secret(bytes(range(32))), STATION))
    robot.dial()
    eventually(lambda: "the lab knows no such key" in caplog.text, "the refusal")
    assert lab.gate.linked() == set()


def test_a_link_of_which_a_part_cannot_begin_ends_as_a_whole(robot, monkeypatch):
    """Else it would go on without its connection for stops, and nobody would start it again."""
    monkeypatch.setattr("runtime.link.station.Relay", lambda *given: 1 / 0)
    robot.dial()
    assert robot.link.failed.wait(PATIENCE_S)
