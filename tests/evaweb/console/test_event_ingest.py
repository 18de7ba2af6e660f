"""What happens at stations comes into the database: once, in order, and in spite of everything."""

from __future__ import annotations

import logging
import threading

import pytest
from django.db import OperationalError, connection

from evaweb.console import event_ingest as chronicle
from evaweb.console.event_ingest import EventIngest, StationEventIngester, ingest_events
from evaweb.console.feed import Feeds, History
from evaweb.stations import commands, leases
from evaweb.stations.models import Command, CommandStatus, Lease, Station
from runtime.processes.coordinator.session.transitions import SessionEvent
from tests.processes import PATIENCE_S, eventually, joined


class Services:
    """Stands where trials and episodes are told; `fail` raises for one of the next events."""

    def __init__(self, monkeypatch):
        self.trials = []
        self.episodes = []
        self.fail = []
        self.news = threading.Condition()
        monkeypatch.setattr(chronicle.trials, "apply_station_event", self.run_changed)
        monkeypatch.setattr(chronicle.episodes, "record_closed", self.episode_closed)

    def run_changed(self, *, station, event, boot):
        with self.news:
            if self.fail:
                raise self.fail.pop()
            self.trials.append((boot, event["number"], event["kind"]))
            self.news.notify_all()

    def episode_closed(self, *, station, data):
        self.episodes.append(data["uuid"])

    def wait(self, reached):
        with self.news:
            assert self.news.wait_for(reached, PATIENCE_S), (self.trials, self.episodes)


@pytest.fixture
def services(monkeypatch):
    return Services(monkeypatch)


def row(number, kind="state", **data):
    return {"number": number, "kind": kind, "text": f"{kind} {number}", "time": 1.0, "data": data}


def history(*rows, boot="b1"):
    return History(boot, tuple(rows))


@pytest.fixture
def station(db):
    return Station.objects.create(name="written-down", robot="agilex_piper")


def test_events_are_handed_on_in_order_and_each_once(station, services):
    seen = history(row(1), row(2, "setup"), row(3, "command"), row(4, "episode_closed", uuid="e1"))
    assert ingest_events(station=station, history=seen) == ("b1", 4)
    ingest_events(station=station, history=seen)
    ingest_events(station=Station.objects.get(), history=seen)  # another web process
    assert services.trials == [("b1", 1, "state"), ("b1", 3, "command"), ("b1", 4, "episode_closed")]
    assert services.episodes == ["e1"]
    station.refresh_from_db()
    assert (station.boot, station.last_event) == ("b1", 4)


def test_after_a_restart_of_the_web_it_goes_on_where_it_was(station, services):
    Station.objects.update(boot="b1", last_event=2)
    station.refresh_from_db()
    ingest_events(station=station, history=history(row(1), row(2), row(3), row(4)))
    assert [number for _, number, _ in services.trials] == [3, 4]


def test_a_restarted_station_begins_anew_with_a_word_of_ours(station, services):
    ingest_events(station=station, history=history(row(1)), state="running")
    ingest_events(station=station, history=history(row(1), boot="b2"), state="disconnected")
    assert services.trials == [("b1", 1, "state"), ("b2", 0, "state"), ("b2", 1, "state")]


def test_a_database_that_is_locked_is_tried_again_from_there(station, services):
    services.fail = [OperationalError("database is locked")]
    with pytest.raises(OperationalError):
        ingest_events(station=station, history=history(row(1), row(2)))
    ingest_events(station=Station.objects.get(), history=history(row(1), row(2)))
    assert [number for _, number, _ in services.trials] == [1, 2]


def test_an_event_that_a_service_cannot_take_is_logged_and_keeps_no_other_back(station, services, caplog):
    services.fail = [KeyError("uuid")]
    ingest_events(station=station, history=history(row(1), row(2)))
    assert [number for _, number, _ in services.trials] == [2]
    assert "event 1 of written-down (state 1) is not in the database" in caplog.text


def test_events_that_are_no_longer_kept_are_said_to_be_lost(station, services, caplog):
    Station.objects.update(boot="b1", last_event=3)
    station.refresh_from_db()
    ingest_events(station=station, history=history(row(9)))
    assert "events 4 to 8 of written-down are lost" in caplog.text
    assert [number for _, number, _ in services.trials] == [9]


def test_a_station_that_is_absent_costs_no_query(station, django_assert_num_queries):
    absent = StationEventIngester(station.name, Feeds())
    with django_assert_num_queries(0):
        absent._write()
        absent._write()


# --- threads --------------------------------------------------------------------------------------------------


@pytest.fixture
def scribe(live, runtime, transactional_db):
    """Writes down what happens at `runtime`; ended before the database is."""
    made = StationEventIngester(runtime.name, Feeds())
    yield made
    made.end()
    joined(made._thread)


def until(reached):
    """Wait for what another thread writes into the database."""
    eventually(reached, "a row")


@pytest.mark.django_db(transaction=True)
def test_a_scribe_hears_and_writes_down(scribe, live, runtime, services, ann):
    runtime.enter(SessionEvent.CONNECTED)
    scribe.start()
    services.wait(lambda: services.trials == [(runtime.boot, 1, "state")])
    runtime.emit("episode_closed", uuid="e1")
    services.wait(lambda: services.episodes == ["e1"])
    until(lambda: Station.objects.get(pk=live.pk).last_event == 2)


@pytest.mark.django_db(transaction=True)
def test_a_lease_that_is_lost_ends_its_row(scribe, live, runtime, services, ann):
    scribe.start()
    lease = leases.claim(user=ann, station=live, page="p1")
    runtime.do(lambda: runtime.lease.release("web:ann:p1", lease.epoch, 0.0))
    until(lambda: Lease.objects.get(pk=lease.pk).ended_at is not None)
    assert Lease.objects.get(pk=lease.pk).end_reason == "expired: it was not renewed"


@pytest.mark.django_db(transaction=True)
def test_a_restart_of_the_runtime_is_written_down(scribe, live, runtime, services, ann):
    scribe.start()
    lease = leases.claim(user=ann, station=live, page="p1")
    until(lambda: Station.objects.get(pk=live.pk).boot == runtime.boot)
    runtime.end()
    runtime.boot_up()
    services.wait(lambda: (runtime.boot, 0, "state") in services.trials)
    until(lambda: Lease.objects.get(pk=lease.pk).end_reason == "the station was restarted")


@pytest.mark.django_db(transaction=True)
def test_a_lost_answer_is_found(scribe, live, runtime, services, ann, settings, monkeypatch):
    settings.EVA_COMMAND_TIMEOUT_S = 0.3
    monkeypatch.setattr(commands, "_patience_s", lambda: 0.1)
    monkeypatch.setattr(chronicle, "_SWEEP_S", 0.2)
    runtime.ready()
    lease = leases.claim(user=ann, station=live, page="p1")
    runtime.swallows.add("run")
    given = {"boot": runtime.boot, "sequence": runtime.session.sequence, "epoch": lease.epoch}
    row = commands.issue_command(user=ann, station=live, kind="run", page="p1", **given)
    assert row.status == CommandStatus.UNKNOWN
    runtime.swallows.clear()
    scribe.start()
    until(lambda: Command.objects.get(pk=row.pk).status == CommandStatus.REFUSED)
    assert runtime.session.state == "ready"


@pytest.mark.django_db(transaction=True)
def test_a_locked_database_delays_and_loses_nothing(scribe, live, runtime, services, caplog, monkeypatch):
    locked = threading.Event()
    locked.set()
    written = chronicle.ingest_events

    def busy(**named):
        if locked.is_set():
            raise OperationalError("database is locked")
        return written(**named)

    monkeypatch.setattr(chronicle, "ingest_events", busy)
    scribe.start()
    with caplog.at_level(logging.WARNING):
        for number in range(3):
            runtime.emit("state", str(number))
        until(lambda: "events are written later: database is locked" in caplog.text)
    locked.clear()
    services.wait(lambda: [number for _, number, _ in services.trials] == [1, 2, 3])


@pytest.mark.django_db(transaction=True)
def test_two_web_processes_write_the_same_and_nothing_twice_in_the_row(live, runtime, services):
    both = [StationEventIngester(runtime.name, Feeds()) for _ in range(2)]
    for one in both:
        one.start()
    for number in range(20):
        runtime.emit("state", str(number))
    until(lambda: Station.objects.get(pk=live.pk).last_event == 20)
    for one in both:
        one.end()
        joined(one._thread)
    numbers = [number for _, number, _ in services.trials]
    assert set(numbers) == set(range(1, 21))


@pytest.mark.django_db(transaction=True)
def test_a_chronicle_finds_stations_that_are_added_later(runtime, services):
    made = EventIngest(Feeds())
    made.start()
    Station.objects.create(name=runtime.name, robot="agilex_piper")
    runtime.emit("state", "hello")
    services.wait(lambda: services.trials == [(runtime.boot, 1, "state")])
    made.end()
    joined(made._thread)
    for scribe in made._scribes.values():
        joined(scribe._thread)
    connection.close()
