"""A station's feed, over real sockets."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest
from django.conf import settings

from evaweb.console import feed as feed_module
from evaweb.console.feed import EVENTS_KEPT, History, LinkState, StationFeed
from runtime.ipc.session_state import SessionState
from runtime.processes.coordinator.session.transitions import SessionEvent
from tests.evaweb.stand_in import old_snapshot
from tests.processes import PATIENCE_S


class Ear:
    """Hears a feed; `wait` for what is wanted of what has been heard."""

    def __init__(self):
        self.heard = []
        self._news = threading.Condition()

    def __call__(self, stream, content):
        with self._news:
            self.heard.append((stream, content))
            self._news.notify_all()

    def wait(self, wanted):
        with self._news:
            assert self._news.wait_for(lambda: any(wanted(*one) for one in self.heard), PATIENCE_S), (
                self.heard[-5:]
            )
            return next(one for one in self.heard if wanted(*one))

    def forget(self):
        with self._news:
            self.heard.clear()


@pytest.fixture
def ear(runtime):
    feed, listener = StationFeed(runtime.name), Ear()
    feed.subscribe(listener, pictures=True)
    listener.feed = feed
    yield listener
    feed.unsubscribe(listener)


def test_everything_that_is_published_is_heard(ear, runtime):
    ear.wait(lambda stream, content: (stream, content) == ("link", LinkState(True)))
    ear.wait(lambda stream, content: stream == "joints" and len(content["measured"]) == 14)
    ear.wait(lambda stream, content: stream == "camera/cam_high" and content.endswith(b"picture"))
    _, state = ear.wait(lambda stream, content: stream == "state")
    assert (state["boot"], state["latency"]) == (runtime.boot, None)


def test_a_station_that_was_started_before_an_upgrade_says_what_its_state_means(ear, runtime, monkeypatch):
    old_snapshot(runtime, monkeypatch)
    runtime.enter(SessionEvent.ESTOPPED)
    _, state = ear.wait(lambda stream, content: stream == "state" and content["state"] == "faulted")
    assert state["state_is"] == SessionState.FAULTED.meaning_dict()


def test_events_are_complete_also_those_from_before(runtime):
    for number in range(5):
        runtime.emit("old", str(number))
    feed, ear = StationFeed(runtime.name), Ear()
    feed.subscribe(ear, pictures=False)
    for number in range(100):
        runtime.emit("new", str(number))
    ear.wait(lambda stream, content: stream == "events" and content.newest == 105)
    feed.unsubscribe(ear)
    assert [row["number"] for row in feed.history.rows] == list(range(1, 106))


def test_a_restarted_runtime_is_found_and_its_events_begin_anew(ear, runtime):
    runtime.emit("before")
    ear.wait(lambda stream, content: stream == "events" and content.newest == 1)
    runtime.end()
    runtime.boot_up()
    runtime.enter(SessionEvent.CONNECTED)
    _, history = ear.wait(lambda stream, content: stream == "events" and content.boot == runtime.boot)
    assert [row["kind"] for row in history.rows] == ["state"]
    ear.wait(lambda stream, content: stream == "state" and content["boot"] == runtime.boot)


def test_a_dead_station_is_a_link_that_says_so(ear, runtime):
    ear.wait(lambda stream, content: (stream, content) == ("link", LinkState(True)))
    runtime.mute = True
    _, link = ear.wait(
        lambda stream, content: stream == "link" and not content.ok and "sign" in content.reason
    )
    assert link.reason.startswith(f"no sign of life from {runtime.name}")
    ear.forget()
    runtime.mute = False
    ear.wait(lambda stream, content: (stream, content) == ("link", LinkState(True)))


@pytest.mark.parametrize(("turns", "silent"), [([0.2] * 9, True), ([10.0, 0.2, 10.0], False)])
def test_only_turns_in_which_the_web_itself_ran_count_as_silence(monkeypatch, turns, silent):
    """The first is a station that says nothing, the second a machine that stood still twice."""
    now, reasons = [0.0], []
    left = iter(turns)

    class Quiet:
        def __init__(self, *_):
            pass

        def receive(self, timeout):
            now[0] += next(left)
            if now[0] >= sum(turns) - 1e-9:
                reader._ended.set()
            return {}

        def close(self):
            pass

    monkeypatch.setattr(feed_module, "Subscriber", Quiet)
    monkeypatch.setattr(feed_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    wire = SimpleNamespace(name="bench-1", address=lambda process, key: "ipc://here")
    reader = feed_module._StateReader(None, wire)
    reader.on_silence = reasons.append
    reader._follow("ipc://here")
    assert bool(reasons) is silent


def test_a_station_that_was_never_started_is_a_link_that_says_so():
    feed, ear = StationFeed("never-started"), Ear()
    feed.subscribe(ear, pictures=False)
    ear.wait(lambda stream, content: stream == "link" and "has to be started" in content.reason)
    feed.unsubscribe(ear)


@pytest.mark.parametrize("content", ["{}", "no json", '{"state": "nowhere"}', '{"state": "tcp://*:?"}'])
def test_an_address_that_cannot_be_used_is_a_link_that_says_so_until_there_is_a_better_one(
    ear, runtime, content
):
    ear.wait(lambda stream, content: (stream, content) == ("link", LinkState(True)))
    path = settings.DATA_DIR / "stations" / runtime.name / "endpoints" / "coordinator.json"
    good = path.read_text()
    path.write_text(content)
    ear.wait(lambda stream, content: stream == "link" and not content.ok and "yet" not in content.reason)
    ear.forget()
    path.write_text(good)
    ear.wait(lambda stream, content: (stream, content) == ("link", LinkState(True)))


def test_what_cannot_be_used_ends_no_feed(ear, runtime):
    ear.wait(lambda stream, content: stream == "state")
    runtime.do(lambda: runtime._streams.publish("state", b"\xc1 no msgpack"))
    runtime.do(lambda: runtime._streams.publish("state", ["no", "map"]))
    ear.forget()
    ear.wait(lambda stream, content: stream == "state" and content["boot"] == runtime.boot)


def test_who_joins_later_is_told_what_is_known_at_once(ear):
    ear.wait(lambda stream, content: stream == "state")
    ear.wait(lambda stream, content: stream == "events")
    later = Ear()
    ear.feed.subscribe(later, pictures=False)
    ear.feed.unsubscribe(later)
    assert {"link", "state", "events"} <= {stream for stream, _ in later.heard}


def test_nothing_is_known_any_more_when_nobody_has_listened(runtime):
    feed, ear = StationFeed(runtime.name), Ear()
    feed.subscribe(ear, pictures=False)
    ear.wait(lambda stream, content: stream == "state")
    feed.unsubscribe(ear)
    assert feed.state == {}
    assert not feed.link.ok


def test_pictures_are_only_followed_while_somebody_wants_them(runtime):
    feed, chronicle, page = StationFeed(runtime.name), Ear(), Ear()
    feed.subscribe(chronicle, pictures=False)
    assert feed._pictures is None
    feed.subscribe(page, pictures=True)
    page.wait(lambda stream, content: stream == "camera/cam_high")
    feed.unsubscribe(page)
    assert feed._pictures is None
    feed.unsubscribe(chronicle)
    assert feed._numbers is None


def test_a_history_keeps_its_numbers_and_the_newest_rows():
    rows = [{"number": number} for number in range(1, EVENTS_KEPT + 11)]
    history = History().extended("b", rows[:7]).extended("b", rows[3:])
    assert history.newest == EVENTS_KEPT + 10
    assert [row["number"] for row in history.rows] == list(range(11, EVENTS_KEPT + 11))
    assert [row["number"] for row in history.after(EVENTS_KEPT + 8)] == [EVENTS_KEPT + 9, EVENTS_KEPT + 10]
    assert history.after(EVENTS_KEPT + 10) == ()
    assert history.extended("c", [{"number": 1}]).rows == ({"number": 1},)
