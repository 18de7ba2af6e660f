"""The live socket, through the whole application, at a runtime without a robot."""

from __future__ import annotations

import asyncio
import threading
from uuid import uuid4

import pytest
from django.conf import settings
from django.contrib.auth.models import AnonymousUser, User
from django.contrib.sessions.models import Session
from django.db import OperationalError, connections

from evaweb.accounts.credentials import credentials
from evaweb.accounts.lookup_pool import FairLookupPool
from evaweb.console import consumers
from evaweb.console import hub as hubs
from evaweb.stations import commands, leases
from evaweb.stations.models import Command, CommandStatus, LeaseRequest, Station
from evaweb.stations.runtime_client import StationConnection
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.session.transitions import SessionEvent
from tests import presses
from tests.evaweb.console.page import Page, cookie, run
from tests.evaweb.noted import wait_for_stop_records
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.django_db(transaction=True)
ALL = ["state", "joints", "poses", "camera/cam_high"]


def test_a_page_is_greeted_and_shown_what_it_watches(live, ann, runtime):
    async def scenario():
        page = await Page(live.name, ann).open()
        hello = await page.told("hello")
        assert (hello["station"], hello["user"], hello["role"], hello["page"]) == (
            live.name,
            "ann",
            "operator",
            "p1",
        )
        assert hello["facts"]["robot"] == "agilex_piper"
        assert len(hello["facts"]["joint_names"]) == 14
        await page.say(type="watch", streams=ALL)
        seen = set()
        while not set(ALL) <= seen:
            frame = await page.shown(lambda streams: True)
            seen |= set(frame.header["streams"])
            for stream in frame.header["streams"]:
                if stream == "state":
                    assert frame.header["streams"]["state"]["json"]["boot"] == runtime.boot
                elif stream == "joints":
                    assert frame.array("joints", "measured").shape == (14,)
                elif stream == "poses":
                    assert frame.array("poses").shape == (2, 20, 16)
                    assert frame.array("poses")[0, :, 15].tolist() == [1.0] * 20
                else:
                    assert frame.data(stream) == b"\xff\xd8 a picture"
                    assert frame.header["streams"][stream]["age"] >= 0
        await page.close()

    run(scenario())


@pytest.mark.parametrize(
    ("who", "name", "query", "code"),
    [
        ("nobody", None, "page=p1", 4401),
        ("ann", "nowhere", "page=p1", 4404),
        ("ann", None, "", 4400),
        ("ann", None, "page=../x", 4400),
    ],
)
def test_a_page_that_has_no_business_here_is_closed_with_a_code(live, ann, who, name, query, code):
    async def scenario():
        page = Page(name or live.name, ann if who == "ann" else AnonymousUser(), query=query)
        assert await page.refused() == code
        await page.say(type="estop", uuid=str(uuid4()))
        await page.close()

    run(scenario())
    assert not Command.objects.exists()


def test_a_page_of_another_site_is_not_let_in(live, ann):
    async def scenario():
        assert not await Page(live.name, ann, origin=b"http://evil.example").connected()
        assert not await Page(live.name, ann, origin=b"http://localhost:9999").connected()
        assert not await Page(live.name, ann, origin=b"http://[").connected()
        assert not await Page(live.name, ann, origin=b"").connected()

    run(scenario())


def test_a_page_that_draws_nothing_is_sent_two_frames(live, ann):
    async def scenario():
        page = await Page(live.name, ann).open()
        page.draws = False
        await page.say(type="watch", streams=ALL)
        while len(page.frames) < 2:
            await page.next()
        await page.told("link", lambda text: text["ok"]) if not page.texts[1:] else None
        assert await page.silent()
        await page.say(type="credit")
        frame = await page.shown(lambda streams: True)
        assert set(frame.header["streams"]) == set(ALL)
        await page.close()

    run(scenario())


def test_who_comes_late_is_shown_the_last_of_everything_at_once(live, ann, vera, runtime):
    async def scenario():
        first = await Page(live.name, ann).open()
        await first.say(type="watch", streams=ALL)
        await first.shown(lambda streams: "state" in streams)
        await first.shown(lambda streams: "camera/cam_high" in streams)
        runtime.mute = True  # nothing new comes any more
        await first.told("link", lambda text: not text["ok"])
        second = await Page(live.name, vera).open()
        assert (await second.told("hello"))["role"] == "viewer"
        await second.say(type="watch", streams=ALL)
        frame = await second.shown(lambda streams: True)
        assert set(frame.header["streams"]) == set(ALL)
        assert not (await second.told("link"))["ok"] if len(second.texts) < 2 else True
        await first.close()
        await second.close()

    run(scenario())


def test_a_lease_is_renewed_and_a_restarted_web_goes_on_with_it(live, ann, runtime):
    lease = leases.claim(user=ann, station=live, page="p1")

    async def scenario():
        for _ in range(2):  # the second is the page after a restart of the web
            page = await Page(live.name, ann).open()
            await page.say(type="renew", epoch=lease.epoch)
            renewed = {"type": "renewed", "ok": True, "lost": False, "reason": "", "epoch": lease.epoch}
            assert await page.told("renewed") == renewed
            await page.close()

    run(scenario())


def test_a_lease_that_is_lost_or_somebody_elses_is_not_renewed(live, ann, bob, runtime, settings):
    lease = leases.claim(user=ann, station=live, page="p1")

    async def scenario():
        thief = await Page(live.name, bob).open()
        await thief.say(type="renew", epoch=lease.epoch)
        answer = await thief.told("renewed")
        assert (answer["ok"], answer["lost"]) == (False, True)
        assert answer["reason"] == "web:ann:p1 holds the lease"
        await thief.close()
        page = await Page(live.name, ann).open()
        runtime.swallows.add("lease_renew")
        settings.EVA_COMMAND_TIMEOUT_S = 0.5
        await page.say(type="renew", epoch=lease.epoch)
        answer = await page.told("renewed")
        assert (answer["ok"], answer["lost"]) == (False, False)
        assert "has not answered lease_renew in time" in answer["reason"]
        await page.close()

    run(scenario())


def test_a_viewer_presses_the_estop_and_it_is_written_down(live, vera, runtime):
    uuid = str(uuid4())

    async def scenario():
        page = await Page(live.name, vera).open()
        await page.say(type="estop", uuid=uuid, why="smoke")
        ack = await page.told("ack")
        assert ack == {
            "type": "ack",
            "kind": "estop",
            "uuid": uuid,
            "status": "done",
            "reason": "every tick now sends the measured position",
        }
        await page.close()
        await _written(uuid)

    run(scenario())
    row = Command.objects.get(pk=uuid)
    assert (row.kind, row.user, row.status, row.args) == ("estop", vera, CommandStatus.DONE, {"why": "smoke"})


async def _written(*uuids):
    """What goes on when pages are closed is finished, and these commands are in the database."""
    while consumers._under_way:
        await asyncio.gather(*consumers._under_way)
    await asyncio.to_thread(_in_the_database, uuids)


def _in_the_database(uuids):
    try:
        wait_for_stop_records()
        eventually(lambda: Command.objects.filter(pk__in=uuids).count() == len(uuids), "they are written")
    finally:
        connections.close_all()


def test_whatever_is_wrong_with_a_press_of_a_page_it_is_pressed_in_text_and_in_bytes(live, ann, runtime):
    async def scenario():
        page = await Page(live.name, ann).open()
        for text in presses.in_json("type").values():
            await page._socket.send_to(text_data=text)
            assert (await page.told("ack"))["status"] == "done"
            await page._socket.send_to(bytes_data=text.encode())
            assert (await page.told("ack"))["status"] == "done"
        await page.close()

    run(scenario())
    assert {command.kind for command in runtime.pressed} == {"estop"}


def test_an_estop_is_pressed_although_the_page_is_closed_at_once(live, vera, runtime):
    async def scenario():
        page = await Page(live.name, vera).open()
        await page.told("hello")
        await page.say(type="estop", uuid=str(uuid4()), why="closing")
        await page.close()
        await _written()

    run(scenario())
    assert [command.args["why"] for command in runtime.pressed] == ["closing"]


def test_the_estop_waits_neither_for_the_database_nor_for_a_renewal(
    live, ann, runtime, monkeypatch, settings
):
    order = []
    lease = leases.claim(user=ann, station=live, page="p1")
    noted = commands.record_estop

    def locked(**named):
        order.append("row")
        return noted(**named)

    monkeypatch.setattr(commands, "record_estop", locked)

    async def scenario():
        page = await Page(live.name, ann).open()
        runtime.swallows.add("lease_renew")
        settings.EVA_COMMAND_TIMEOUT_S = 2.0
        await page.say(type="renew", epoch=lease.epoch)  # hangs until its deadline
        await page.say(type="estop", uuid=str(uuid4()), why="smoke")
        first = await page.told("ack")
        order.insert(0, first["status"])
        assert all(text["type"] != "renewed" for text in page.texts)
        await page.told("renewed")
        await page.close()
        await _written()

    run(scenario())
    assert order == ["done", "row"]


def test_the_estop_does_not_queue_behind_stops_that_hang(live, ann, runtime, settings):
    settings.EVA_COMMAND_TIMEOUT_S = 3.0  # which a hundred stops hang, and the e-stop does not
    runtime.swallows = {"stop"}

    async def scenario():
        page = await Page(live.name, ann).open()
        for _ in range(100):
            await page.say(type="stop", uuid=str(uuid4()), epoch=1)
        await page.say(type="estop", uuid=str(uuid4()), why="it does not stop")
        first = await page.told("ack")
        assert (first["kind"], first["status"]) == ("estop", "done")
        for _ in range(100):
            assert (await page.told("ack"))["status"] == "unknown"
        await page.close()
        await _written()

    run(scenario())


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda ann: User.objects.filter(pk=ann.pk).update(is_active=False), 4401),
        (lambda ann: Session.objects.all().delete(), 4401),
        (lambda ann: User.objects.filter(pk=ann.pk).update(password="another"), 4401),
        (lambda ann: ann.groups.clear(), 4403),
    ],
    ids=["switched off", "logged out", "another password", "another role"],
)
def test_who_may_not_be_there_any_more_is_shown_out_and_keeps_no_lease(
    live, ann, runtime, monkeypatch, change, code
):
    monkeypatch.setattr(consumers, "_LOGIN_S", 0.02)
    lease = leases.claim(user=ann, station=live, page="p1")

    async def scenario():
        page = await Page(live.name, ann).open()
        await page.say(type="renew", epoch=lease.epoch)
        assert (await page.told("renewed"))["ok"]
        await asyncio.to_thread(_closed_after, change, ann)
        while (said := await page.next()).get("type") != "websocket.close":
            pass
        assert said["code"] == code
        await page.close()

    run(scenario())


def _closed_after(change, ann):
    change(ann)
    connections.close_all()


def test_a_page_outlasts_a_database_that_does_not_say_who_is_logged_in(live, ann, runtime, monkeypatch):
    asked = threading.Event()

    def away(session):
        asked.set()
        raise OperationalError("gone")

    monkeypatch.setattr(consumers, "_LOGIN_S", 0.02)
    monkeypatch.setattr(consumers, "current_role", away)
    lease = leases.claim(user=ann, station=live, page="p1")

    async def scenario():
        page = await Page(live.name, ann).open()
        assert await asyncio.to_thread(asked.wait, 10)
        await page.say(type="renew", epoch=lease.epoch)
        assert (await page.told("renewed"))["ok"]
        await page.close()

    run(scenario())


@pytest.mark.parametrize("loaded_anew", [False, True])
def test_a_run_goes_on_for_a_minute_without_the_database_and_stops_work_for_longer(
    live, ann, runtime, monkeypatch, loaded_anew
):
    now, away, look = [1000.0], threading.Event(), credentials.look_up

    def gone(kind, secret):
        if away.is_set():
            raise OperationalError("gone")
        return look(kind, secret)

    monkeypatch.setattr(credentials, "look_up", gone)
    monkeypatch.setattr(credentials, "_clock", lambda: now[0])
    lease = leases.claim(user=ann, station=live, page="p1")

    async def scenario():
        page = await Page(live.name, ann).open()
        await page.told("hello")
        away.set()
        now[0] += 59
        if loaded_anew:
            await page.close()
            assert await page.connected()
        else:
            await page.say(type="aim", id=1, args={"pose": "home"})
            assert (await page.told("aimed"))["ok"]
        await page.say(type="renew", epoch=lease.epoch)
        assert (await page.told("renewed"))["ok"]
        now[0] += 2
        if not loaded_anew:
            await page.say(type="aim", id=2, args={"pose": "home"})
            assert "has not answered for 60 s" in (await page.told("aimed"))["reason"]
            await page.say(type="renew", epoch=lease.epoch)
            refused = await page.told("renewed")
            assert (refused["ok"], refused["lost"], refused["reason"]) == (False, False, consumers._NOT_SAID)
        await page.say(type="halt", uuid=str(uuid4()), epoch=lease.epoch)
        assert (await page.told("ack"))["status"] == "accepted"
        await page.say(type="estop", uuid=str(uuid4()), why="smoke")
        assert (await page.told("ack"))["status"] == "done"
        away.clear()
        await page.close()
        await _written()

    runtime.ready()
    runtime.do(lambda: runtime.session._enter(SessionState.RUNNING, ""))
    run(scenario())


@pytest.mark.parametrize(("kind", "state"), [("stop", "ready"), ("halt", "holding")])
def test_the_holder_stops_over_the_socket_and_it_is_written_down_later(live, ann, bob, runtime, kind, state):
    lease = leases.claim(user=ann, station=live, page="p1")
    runtime.ready()
    runtime.do(lambda: runtime.session._enter(SessionState.RUNNING, ""))
    uuid = str(uuid4())

    async def scenario():
        other = await Page(live.name, bob).open()
        await other.say(type=kind, uuid=str(uuid4()), epoch=lease.epoch)
        refused = await other.told("ack")
        assert (refused["status"], refused["reason"]) == ("refused", "ann holds the lease")
        await other.close()
        assert runtime.session.state == "running"
        page = await Page(live.name, ann).open()
        await page.say(type=kind, uuid=uuid, epoch=lease.epoch)
        ack = await page.told("ack")
        assert (ack["kind"], ack["uuid"], ack["status"]) == (kind, uuid, "accepted")
        await page.close()
        await _written(uuid)

    run(scenario())
    assert runtime.session.state == state
    row = Command.objects.get(pk=uuid)
    assert (row.kind, row.user, row.holder, row.status) == (kind, ann, "web:ann:p1", CommandStatus.ACCEPTED)


def test_an_estop_that_cannot_be_delivered_says_use_the_hardware_stop(ann):
    Station.objects.create(name="switched-off", robot="agilex_piper")

    async def scenario():
        page = await Page("switched-off", ann).open()
        await page.say(type="estop", uuid=str(uuid4()))
        ack = await page.told("ack")
        assert ack["status"] == "failed"
        assert ack["reason"].startswith("USE THE HARDWARE STOP")
        await page.close()
        await _written()

    run(scenario())


def test_events_come_without_gaps_over_a_restart(live, ann, runtime):
    for number in range(3):
        runtime.emit("before", str(number))

    async def scenario():
        page = await Page(live.name, ann).open()
        await page.say(type="events", after=1)
        told = await page.told("events")
        assert [row["number"] for row in told["events"]] == [2, 3]
        runtime.emit("live", "now")
        assert [row["text"] for row in (await page.told("events"))["events"]] == ["now"]
        runtime.end()
        runtime.boot_up()
        runtime.enter(SessionEvent.CONNECTED)
        told = await page.told("events")
        assert (told["boot"], [row["number"] for row in told["events"]]) == (runtime.boot, [1])
        await page.close()

    run(scenario())


def test_a_station_that_dies_and_comes_back_is_said(live, ann, runtime):
    async def scenario():
        page = await Page(live.name, ann).open()
        await page.told("link", lambda text: text["ok"])
        await page.say(type="watch", streams=["state"])
        runtime.end(tidy=True)
        gone = await page.told("link", lambda text: not text["ok"])
        assert gone["reason"] == f"{live.name} is not running: its runtime has to be started"
        runtime.boot_up()
        await page.told("link", lambda text: text["ok"])
        await page.shown(
            lambda streams: "state" in streams and streams["state"]["json"]["boot"] == runtime.boot
        )
        await page.close()

    run(scenario())


def test_what_changes_in_the_database_is_said(live, ann, bob, runtime, monkeypatch):
    lease = leases.claim(user=ann, station=live, page="p1")
    looked, look = asyncio.Event(), hubs.change_marks.read_marks

    async def watched(station):
        found = await look(station)
        looked.set()
        return found

    monkeypatch.setattr(hubs.change_marks, "read_marks", watched)
    monkeypatch.setattr(hubs, "_CHANGES_S", 0.05)

    async def scenario():
        page = await Page(live.name, ann).open()
        await looked.wait()
        await asyncio.to_thread(LeaseRequest.objects.create, station=live, user=bob, holder="web:bob:p2")
        assert (await page.told("changed"))["what"] == ["lease"]
        await page.close()

    run(scenario())
    assert lease.pk


def test_what_means_nothing_is_answered_with_what_is_allowed_and_at_last_with_the_end(live, ann):
    async def scenario():
        page = await Page(live.name, ann).open()
        await page.say(type="jump")
        assert "'jump' is unknown; allowed: watch" in (await page.told("error"))["reason"]
        for _ in range(25):
            await page.say(type="jump")
        while (found := await page.next()).get("type") != "websocket.close":
            assert found["type"] in ("error", "link")
        assert found["code"] == 4400
        await page.close()

    run(scenario())


def test_a_station_with_an_unknown_robot_can_be_stopped_all_the_same(live, ann, runtime):
    Station.objects.filter(pk=live.pk).update(robot="unknown")

    async def scenario():
        page = await Page(live.name, ann).open()
        assert "robot 'unknown' does not exist" in (await page.told("hello"))["facts"]["error"]
        await page.say(type="watch", streams=["state", "joints"])
        await page.shown(lambda streams: "joints" in streams)
        await page.say(type="estop", uuid=str(uuid4()))
        assert (await page.told("ack"))["status"] == "done"
        await page.close()
        await _written()

    run(scenario())


def test_an_operator_aims_over_the_socket_and_nothing_is_commanded(live, ann, runtime):
    async def scenario():
        page = await Page(live.name, ann).open()
        await page.say(type="aim", id=5, args={"pose": "home"})
        found = await page.told("aimed")
        assert (found["id"], found["ok"], found["reached"], len(found["links"])) == (5, True, True, 20 * 16)
        await page.close()

    run(scenario())
    assert runtime.commands == []
    assert not Command.objects.exists()


def test_a_viewer_aims_at_nothing(live, vera, runtime):
    async def scenario():
        page = await Page(live.name, vera).open()
        await page.say(type="aim", id=5, args={"pose": "home"})
        assert not (await page.told("aimed"))["ok"]
        await page.close()

    run(scenario())
    assert runtime.aims == []


def test_an_aim_that_hangs_keeps_no_stop_and_no_command_waiting(live, ann, runtime, settings):
    lease = leases.claim(user=ann, station=live, page="p1")
    runtime.swallows.add("aim")
    settings.EVA_COMMAND_TIMEOUT_S = 2.0
    runtime.ready()
    runtime.do(lambda: runtime.session._enter(SessionState.RUNNING, ""))

    async def scenario():
        page = await Page(live.name, ann).open()
        await page.say(type="aim", id=1, args={})
        given = {"user": ann, "station": live, "page": "p1", "epoch": lease.epoch, "boot": runtime.boot}
        row = await asyncio.to_thread(_given, kind="stop", **given)
        assert row.status == CommandStatus.ACCEPTED
        await page.say(type="renew", epoch=lease.epoch)
        assert (await page.told("renewed"))["ok"]
        assert all(text["type"] != "aimed" for text in page.texts)
        late = await page.told("aimed")
        assert "has not answered aim in time" in late["reason"]
        await page.close()

    run(scenario())


def _given(**command):
    try:
        return commands.issue_command(**command)
    finally:
        connections.close_all()


def test_the_chunk_and_every_sample_of_the_joints_are_shown(live, ann, runtime):
    async def scenario():
        page = await Page(live.name, ann).open()
        await page.say(type="watch", streams=["recent", "chunk"])
        frame = await page.shown(lambda streams: "recent" in streams)
        assert frame.array("recent", "executed").shape[1] == 14
        rows = [[0.1] * 14] * 3
        await asyncio.to_thread(
            runtime.publish, "chunk", {"chunk": 4, "state": "merged", "targets": [-1, 7, 8], "rows": rows}
        )
        frame = await page.shown(lambda streams: "chunk" in streams)
        assert frame.header["streams"]["chunk"]["json"]["targets"] == [-1, 7, 8]
        assert frame.array("chunk", "tips").shape == (3, 2, 3)
        await page.close()

    run(scenario())


def test_a_flood_of_presses_at_a_dead_station_is_two_and_another_station_is_stopped_meanwhile(
    ann, vera, make_stand_in, settings
):
    dead, alive = make_stand_in(), make_stand_in()
    for one in (dead, alive):
        Station.objects.create(name=one.name, robot="agilex_piper")
    dead.mute = True
    settings.EVA_COMMAND_TIMEOUT_S = 3.0
    presses = []
    urgent = StationConnection.request_urgent

    def counted(self, command, *given):
        presses.append(self.name)
        return urgent(self, command, *given)

    async def scenario():
        flooding = await Page(dead.name, vera).open()
        await flooding.told("hello")
        page = await Page(alive.name, ann).open()
        await page.told("hello")
        for _ in range(1500):
            await flooding.say(type="estop", uuid=str(uuid4()))
        await page.say(type="estop", uuid=str(uuid4()))
        assert (await page.told("ack"))["status"] == "done"
        assert (await flooding.told("ack"))["reason"].startswith("USE THE HARDWARE STOP")
        await page.close()
        await flooding.close()
        await _written()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StationConnection, "request_urgent", counted)
        run(scenario())
    # Those of 1500 that came while the first was out are one more; what came later still makes another pair.
    assert presses.count(alive.name) == 1
    assert 1 <= presses.count(dead.name) < 20
    rows = Command.objects.filter(station__name=dead.name)
    assert 1 <= rows.count() < 20


@pytest.mark.parametrize("kind", ["stop", "halt"])
def test_a_viewers_stop_is_refused_before_anything_is_done(live, vera, runtime, kind):
    uuid = str(uuid4())

    async def scenario():
        page = await Page(live.name, vera).open()
        await page.told("hello")
        for _ in range(50):
            await page.say(type=kind, uuid=uuid, epoch=1)
        ack = await page.told("ack")
        assert (ack["uuid"], ack["status"]) == (uuid, "refused")
        assert "vera is a viewer; this needs an operator" in ack["reason"]
        await page.close()
        await _written()

    run(scenario())
    assert runtime.commands == []
    assert not Command.objects.exists()


def test_a_page_that_floods_is_told_once_and_closed_and_its_presses_are_obeyed(
    live, ann, runtime, monkeypatch
):
    monkeypatch.setattr("evaweb.console.flow_control.PER_SECOND", 0.0)
    monkeypatch.setattr("evaweb.console.flow_control.AT_ONCE", 5.0)

    async def scenario():
        page = await Page(live.name, ann).open()
        page.draws = False
        for _ in range(50):
            await page.say(type="credit")
        await page.say(type="estop", uuid=str(uuid4()), why="at last")
        while (said := await page.next()).get("type") != "websocket.close":
            pass
        assert said["code"] == 4429
        assert [text["type"] for text in page.texts].count("error") == 1
        await page.close()
        await asyncio.to_thread(eventually, lambda: runtime.pressed, "the press is obeyed")
        await _written()

    run(scenario())
    assert [command.args["why"] for command in runtime.pressed] == ["at last"]


@pytest.mark.parametrize("remembered", [True, False])
def test_a_page_that_opens_while_the_database_is_away_can_stop(live, ann, runtime, monkeypatch, remembered):
    """By whom is known where this process has seen the login before."""
    lease = leases.claim(user=ann, station=live, page="p1")
    runtime.ready()
    runtime.do(lambda: runtime.session._enter(SessionState.RUNNING, ""))
    away, pressed = threading.Event(), str(uuid4())
    look = credentials.look_up

    def gone(kind, secret):
        if away.is_set():
            raise OperationalError("gone")
        return look(kind, secret)

    monkeypatch.setattr(credentials, "look_up", gone)
    monkeypatch.setattr(consumers, "_AGAIN_S", 0.02)

    async def scenario():
        page = Page(live.name, ann)
        if remembered:
            first = await page.open()
            await first.told("hello")
            await first.close()
        away.set()
        assert await page.connected()
        await page.say(type="halt", uuid=str(uuid4()), epoch=lease.epoch)
        halted = await page.told("ack")
        assert halted["status"] == ("accepted" if remembered else "failed")
        await page.say(type="estop", uuid=pressed, why="smoke")
        assert (await page.told("ack"))["status"] == "done"
        away.clear()
        assert (await page.told("hello"))["user"] == "ann"
        await page.close()
        await _written(pressed)

    run(scenario())
    assert [command.user for command in runtime.pressed] == ["ann" if remembered else "unverified"]
    row = Command.objects.get(kind="estop")
    assert (row.user, "unverified" in row.args) == ((ann, False) if remembered else (None, True))


@pytest.mark.parametrize("order", [slice(None), slice(None, None, -1)])
def test_a_page_with_several_cookies_of_that_name_is_whose_session_is_any_of_them(live, ann, runtime, order):
    name = settings.SESSION_COOKIE_NAME
    cookies = [f"{name}=elsewhere", f"{name}={cookie(ann)}"][order]

    async def scenario():
        page = Page(live.name, ann)
        page._headers.append((b"cookie", "; ".join(cookies).encode()))
        await page.open()
        assert (await page.told("hello"))["user"] == "ann"
        await page.say(type="estop", uuid=str(uuid4()), why="smoke")
        assert (await page.told("ack"))["status"] == "done"
        await page.close()
        await _written()

    run(scenario())
    assert [command.user for command in runtime.pressed] == ["ann"]


def test_a_page_that_has_no_turn_to_be_looked_up_presses_unverified_and_halts_nothing(
    live, ann, runtime, monkeypatch
):
    def gone(*given):
        raise OperationalError("gone")

    monkeypatch.setattr(consumers, "_admitted", gone)
    full, begun, turn = FairLookupPool(1, most=1), threading.Event(), threading.Event()
    full.submit("nowhere", lambda: begun.set() or turn.wait(PATIENCE_S))
    assert begun.wait(PATIENCE_S)
    full.submit("nowhere", lambda: None)
    monkeypatch.setattr(credentials, "_strangers", full)

    async def scenario():
        page = await Page(live.name, ann).open()
        for kind, status in (("estop", "done"), ("halt", "failed")):
            await page.say(type=kind, uuid=str(uuid4()), epoch=1)
            said = await page.told("ack")
            assert (said["kind"], said["status"]) == (kind, status)
        assert "too many logins from this address are looked up at once" in said["reason"]
        turn.set()
        await page.close()
        await _written()

    run(scenario())
    assert [command.user for command in runtime.pressed] == ["unverified"]
    assert runtime.commands == []
