"""A station on another computer that lets nothing in: enrolled, commanded, stopped, lost, withdrawn."""

from __future__ import annotations

import os
import time
from uuid import uuid4

import pytest

from evaweb.console.feed import StationFeed
from evaweb.core.errors import StationGone
from evaweb.episodes.job_kinds import look_for_arrived
from evaweb.stations import commands, enrolment, leases, stops
from evaweb.stations.models import CommandStatus, Station
from evaweb.stations.runtime_client import connection_to
from runtime.ipc.bus import Endpoints
from runtime.link.uplink import read_uplink
from tests.evaweb.stations.elsewhere import Elsewhere, Loopback, Namespaces
from tests.namespaces import why_no_namespaces
from tests.processes import PATIENCE_S, eventually
from tests.runtime.link.episodes import content, recorded

pytestmark = [pytest.mark.django_db(transaction=True), pytest.mark.slow, pytest.mark.lab]


@pytest.fixture
def elsewhere(request, tmp_path, settings):
    """Loopback, or two namespaces with a firewall."""
    net = Loopback()
    if getattr(request, "param", "") == "namespaces":
        if why := why_no_namespaces():
            pytest.skip(why)
        net = Namespaces()
    made = Elsewhere(tmp_path, net, f"bench-{uuid4().hex[:8]}")
    try:
        made.gate()
        settings.EVA_GATE, settings.EVA_GATE_NAME = (net.host, made.port), ""
        yield made
    finally:
        made.close()


def enrolled(elsewhere, alma):
    """The station as the lab has it, its computer enrolled and linked."""
    station = Station.objects.create(name=elsewhere.name, robot="agilex_piper")
    shown = enrolment.code_make(user=alma, station=station)
    told = elsewhere.keys("new")
    words = shown.command.split()[3:]
    said = elsewhere.keys(*words)
    assert shown.fingerprint in said
    assert told.split(": ")[1] in said
    elsewhere.link()
    eventually(lambda: is_linked(elsewhere.name), f"the link; {elsewhere.log('gate')}")
    return station


def is_linked(name):
    try:
        return connection_to(name).status()
    except StationGone:
        return None


def pressed(name, user):
    """The answer to a press, once it is one: a machine that is busy may lose a link for a moment."""

    def press():
        answer = stops.press_estop(station=name, username=user.username, why="a test", uuid=uuid4()).result()
        return answer if answer.status is CommandStatus.DONE else None

    return eventually(press, "the answer to a press")


@pytest.mark.parametrize("elsewhere", ["loopback", "namespaces"], indirect=True)
def test_a_station_elsewhere_is_commanded_and_stopped_as_one_of_this_computer(elsewhere, alma, ann):
    station = enrolled(elsewhere, alma)
    robot = elsewhere.station
    robot.ready()
    lease = eventually(lambda: claimed(ann, station), "the lease")
    assert robot.lease.status(0.0)["holder"] == "web:ann:p1"
    row = eventually(lambda: run(ann, station, lease), "the run")
    assert (robot.commands[-1].kind, robot.commands[-1].user) == ("run", "ann")
    assert (robot.commands[-1].role, row.status) == ("operator", CommandStatus.ACCEPTED)
    assert pressed(station.name, ann).reason == "every tick now sends the measured position"
    assert {one.user for one in robot.pressed} == {"ann"}
    assert {one.role for one in robot.pressed} <= {"", "unverified"}  # that of a press needs none


def claimed(user, station):
    try:
        return leases.claim(user=user, station=station, page="p1")
    except StationGone:
        return None


def run(user, station, lease):
    try:
        snapshot = connection_to(station.name).status()
    except StationGone:
        return None
    where = {"boot": snapshot["boot"], "sequence": snapshot["sequence"]}
    row = commands.issue_command(
        user=user, station=station, kind="run", page="p1", epoch=lease.epoch, **where
    )
    return row if row.status is CommandStatus.ACCEPTED else None


@pytest.mark.parametrize("elsewhere", ["namespaces"], indirect=True)
def test_a_cable_that_is_pulled_is_seen_and_one_that_is_plugged_in_again_found(elsewhere, alma, ann):
    station = enrolled(elsewhere, alma)
    feed, links = StationFeed(station.name), []
    at_the_robot = Endpoints(elsewhere.data / "stations" / station.name)

    def linked_there():
        told = read_uplink(at_the_robot)
        return told is not None and told["why"] == ""

    eventually(linked_there, "what the robot's computer says")

    def heard(stream, content):
        if stream == "link":
            links.append(content)

    feed.subscribe(heard, pictures=False)
    try:
        eventually(lambda: links[-1].ok, "the live page")
        elsewhere.net.pull()
        eventually(lambda: "link to its computer is lost" in links[-1].reason, "what the page says")
        eventually(lambda: read_uplink(at_the_robot)["why"], "what the robot's computer says")
        assert 0 <= time.time() - read_uplink(at_the_robot)["since"] < PATIENCE_S
        answer = stops.press_estop(station=station.name, username="ann", why="a test", uuid=uuid4()).result()
        assert answer.status is CommandStatus.FAILED
        assert answer.reason.startswith("USE THE HARDWARE STOP: not sent, the link to")
        elsewhere.net.plug()
        eventually(lambda: links[-1].ok, "the live page again")
        eventually(lambda: read_uplink(at_the_robot)["why"] == "", "what the robot's computer says again")
        pressed(station.name, ann)
    finally:
        feed.unsubscribe(heard)


def test_a_key_that_is_withdrawn_is_no_station_any_more(elsewhere, alma):
    station = enrolled(elsewhere, alma)
    enrolment.key_withdraw(user=alma, key=station.keys.get())
    eventually(lambda: "withdrawn" in elsewhere.log("link"), "what its computer is told")
    eventually(lambda: "was withdrawn" in why_gone(station.name), "what the lab says")


def test_an_episode_arrives_whole_though_both_ends_are_killed_on_its_way(elsewhere, alma, settings):
    enrolled(elsewhere, alma)
    elsewhere.kill("link")
    folder = recorded(elsewhere.data, elsewhere.name)
    (folder / "front.mp4").write_bytes(os.urandom(4_000_000))
    whole = content(folder)
    partly = settings.DATA_DIR / "episodes" / ".arriving" / elsewhere.name / folder.name / "front.mp4"
    elsewhere.link(EVA_UPLOAD_MB_S="0.5")
    for end in ("gate", "link", "gate"):
        here = partly.stat().st_size if partly.exists() else 0
        eventually(lambda more=here: partly.exists() and partly.stat().st_size > more, "more of it")
        elsewhere.kill(end)
        getattr(elsewhere, end)(**({"EVA_UPLOAD_MB_S": "0.5"} if end == "link" else {}))
    assert partly.stat().st_size < 4_000_000
    elsewhere.kill("link")
    elsewhere.link(EVA_UPLOAD_MB_S="50", EVA_KEEP_DAYS="0")
    eventually(lambda: not folder.exists(), f"the lab's word; {elsewhere.log('link')[-2000:]}")
    assert content(settings.DATA_DIR / "episodes" / folder.name) == whole
    assert look_for_arrived() == 1


def why_gone(name):
    try:
        connection_to(name).status(timeout=1.0)  # what was asked as it was withdrawn is never answered
    except StationGone as gone:
        return str(gone)
    return ""
