"""What happened at a station elsewhere while its link was lost is brought up when it is back: all of it, each once."""

from __future__ import annotations

import threading
import time

import pytest

from evaweb.console import event_ingest as chronicle
from evaweb.console.event_ingest import StationEventIngester
from evaweb.console.feed import Feeds
from evaweb.stations.models import Lease, Station
from runtime.ipc.messages import Command
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.session.transitions import SessionEvent
from tests.processes import eventually
from tests.runtime.link.linked import STATION, Lab, Robot, allowed

pytestmark = pytest.mark.django_db(transaction=True)


@pytest.fixture
def lab(settings, monkeypatch):
    """A gate over the data folder of the web; a busy machine loses no link by itself."""
    for name in ("line.LOST_S", "line._GREETED_S", "remote.LOST_S", "tokens.VALID_S", "gate._HELD_S"):
        monkeypatch.setattr(f"runtime.link.{name}", 60.0)
    made = Lab(settings.DATA_DIR)
    yield made
    made.end()


@pytest.fixture
def robot(tmp_path, lab):
    """Linked, in a scored run of ann's."""
    made = Robot(tmp_path / "robot", lab)
    lab.allowed.now = allowed((made.key, STATION))
    made.dial()
    lab.linked()
    made.station.ready()
    made.station.do(lambda: made.station.lease.claim("web:ann:p1", 1, time.monotonic(), "ann"))
    made.station.do(lambda: made.station.session._enter(SessionState.RUNNING, ""))
    yield made
    made.end()


@pytest.fixture
def told(monkeypatch):
    """Numbers and kinds of the events that reach the database's services, in order."""
    made = []
    monkeypatch.setattr(
        chronicle.trials,
        "apply_station_event",
        lambda station, event, boot: made.append((event["number"], event["kind"])),
    )
    monkeypatch.setattr(chronicle.episodes, "record_closed", lambda station, data: None)
    return made


@pytest.fixture
def web(told):
    """Starts a web's chronicle, any number of times."""
    scribes = []

    def start():
        scribes.append(StationEventIngester(STATION, Feeds()))
        scribes[-1].start()
        return scribes[-1]

    yield start
    for scribe in scribes:
        scribe.end()
        scribe._thread.join()


def happens(robot):
    """What goes on at the robot while nobody else sees it; numbers and kinds of the events that count."""
    station = robot.station
    station.emit("command", "lease_renew: refused", uuid="")
    station.do(lambda: setattr(station.lease, "_held", None))
    station.enter(SessionEvent.HOLDER_LOST, "nobody commands the station")
    for number in range(40):
        station.emit("limited", f"limited {number}")
    panel = Command("stop-7", "stop", user="panel:10.0.0.3", holder="panel:10.0.0.3", role="local")
    station.do(lambda: station._answer(panel))
    station.emit("episode_closed", "episode closed", uuid="e1", status="finished")
    return station.events.newest


def counted(robot, first):
    """What the services have to be told of after the event `first`, each once."""
    rows = robot.station.events.since(first)
    return [(row["number"], row["kind"]) for row in rows if row["kind"] in chronicle.NOTED]


def test_what_happened_during_a_loss_is_written_down_when_the_link_is_back(lab, robot, told, web):
    station = Station.objects.create(name=STATION, robot="agilex_piper")
    web()
    robot.station.emit("command", "before the loss", uuid="")
    before = robot.station.events.newest
    eventually(lambda: Station.objects.get(pk=station.pk).last_event == before, "what was before")
    assert Lease.objects.get(station=station).ended_at is None
    seen = list(told)
    robot.hang_up()
    lab.lost()
    newest = happens(robot)
    assert told == seen
    robot.dial()
    eventually(lambda: Station.objects.get(pk=station.pk).last_event == newest, "what was missed")
    assert told == [*seen, *counted(robot, before)]
    assert told[-3:] == [(newest - 42, "state"), (newest - 1, "command"), (newest, "episode_closed")]
    eventually(lambda: Lease.objects.get(station=station).ended_at, "the end of the lease")


def test_a_lab_whose_gate_and_web_were_down_too_misses_nothing_and_doubles_nothing(lab, robot, told, web):
    station = Station.objects.create(name=STATION, robot="agilex_piper")
    first = web()
    before = robot.station.events.newest
    eventually(lambda: Station.objects.get(pk=station.pk).last_event == before, "what was before")
    first.end()
    first._thread.join()
    port, second_port = lab.gate.port, lab.gate.second_port
    lab.end()
    newest = happens(robot)
    told.clear()
    lab.begin(port, second_port)
    lab.linked()
    web()
    eventually(lambda: Station.objects.get(pk=station.pk).last_event == newest, "what was missed")
    assert told == counted(robot, before)
    assert len(set(told)) == len(told)


def test_a_link_that_flaps_while_things_happen_doubles_nothing(lab, robot, told, web):
    station = Station.objects.create(name=STATION, robot="agilex_piper")
    web()
    ended = threading.Event()

    def goes_on():
        number = 0
        while not ended.wait(0.005):
            robot.station.emit("state", f"state {number}", state="running")
            number += 1

    busy = threading.Thread(target=goes_on)
    busy.start()
    try:
        for _ in range(3):
            robot.hang_up()
            lab.lost()
            robot.dial()
            lab.linked()
    finally:
        ended.set()
        busy.join()
    newest = robot.station.events.newest
    eventually(lambda: Station.objects.get(pk=station.pk).last_event == newest, "all of it")
    assert told == counted(robot, 0)
