"""Ingest of stations' events into the database, with or without viewers.

One thread per station reads its feed and passes events to the services in order, each at least once: the number of the
last one is stored in the station's row. Services accept repeated events, so any number of web processes may do this in
parallel. If the database is busy or unavailable, the thread retries; nothing live waits for it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping
from typing import Any

from django.db import Error, close_old_connections
from django.db.models import Q

from evaweb.collect import station_events as collect
from evaweb.console.feed import Feeds, History, feeds
from evaweb.episodes import services as episodes
from evaweb.preflights.services import refresh_preflights
from evaweb.stations import commands, leases
from evaweb.stations.models import Station
from evaweb.trials import services as trials

log = logging.getLogger(__name__)
# Kinds of events that change rows; all others are only displayed.
NOTED = ("state", "command", "truth", "episode_closed", "labelled")
_TURN_S = 1.0
_SWEEP_S = 5.0  # period of searching for lost results


class StationEventIngester:
    """Thread that writes one station's events and lease changes to the database.

    They are written in order, and each at least once.
    """

    def __init__(self, station: str, heard: Feeds) -> None:
        self._station = station
        self._feed = heard.get(station)
        self._ended = threading.Event()
        self._news = threading.Event()
        self._written = ("", 0)  # boot and number of the last event written
        self._lease: tuple[Any, ...] = ()
        self._collects: bool | None = None  # value in the station's row; None: not known yet
        self._swept = 0.0
        self._failing = False
        self._thread = threading.Thread(target=self._run, name=f"{station} events", daemon=True)

    def start(self) -> None:
        """Subscribe to the feed and start the thread."""
        self._feed.subscribe(self._on_stream, pictures=False)
        self._thread.start()

    def end(self) -> None:
        """Unsubscribe; the thread ends after its current write."""
        self._feed.unsubscribe(self._on_stream)
        self._ended.set()
        self._news.set()

    def _on_stream(self, stream: str, content: Any) -> None:
        if stream == "events" or (stream == "state" and self._lease_of(content) != self._lease):
            self._news.set()

    def _run(self) -> None:
        while not self._ended.is_set():
            self._news.wait(_TURN_S)
            self._news.clear()
            close_old_connections()
            try:
                self._write()
                self._failing = False
            except Error as error:
                self._log_retry(error)
            except Exception:  # a station of another version must not end the thread
                log.exception("what happens at %s cannot be written down", self._station)
                self._ended.wait(_TURN_S)
            finally:
                close_old_connections()

    def _log_retry(self, error: Exception) -> None:
        if not self._failing:
            log.warning("%s: events are written later: %s", self._station, error)
        self._failing = True
        self._ended.wait(_TURN_S)
        self._news.set()

    def _write(self) -> None:
        """Write the lease first, then events, then outcomes of commands and preflights whose answers were lost.

        A station without a row is skipped.
        """
        sweep = self._feed.link.ok and time.monotonic() - self._swept > _SWEEP_S
        state, history = self._feed.state, self._feed.history
        lease = self._lease_of(state)
        behind = bool(history.boot) and self._written != (history.boot, history.newest)
        collects = state.get("collect") is not None if state else self._collects
        if not (sweep or behind or lease != self._lease or collects != self._collects):
            return
        station = Station.objects.filter(name=self._station).first()
        if station is None:
            return
        if collects is not None and collects != self._collects:
            Station.objects.filter(pk=station.pk).update(collects=collects)
            self._collects = collects
        if lease:
            leases.record_snapshot_lease(station=station, boot=state["boot"], held=state["lease"])
            self._lease = lease
        if behind:
            self._written = ingest_events(station=station, history=history, state=str(state.get("state", "")))
        if sweep:
            for row in commands.unresolved_commands(station=station):
                commands.resolve_unknown_outcome(row=row)
            refresh_preflights(station=station)
            self._swept = time.monotonic()

    @staticmethod
    def _lease_of(state: Mapping[str, Any]) -> tuple[Any, ...]:
        return (state["boot"], state["lease"]["holder"], state["lease"]["epoch"]) if state else ()


def ingest_events(*, station: Station, history: History, state: str = "") -> tuple[str, int]:
    """Pass all new events to the services; return the boot id and number of the last event.

    If the runtime has restarted, the first event passed on is a synthetic one with the station's `state`, because the
    restarted station may emit no event of its own for a long time.
    """
    if station.boot != history.boot:
        if station.boot and state:
            _hand_on(station, history.boot, _restarted(history, state))
        station.boot, station.last_event = history.boot, 0
        station.save(update_fields=["boot", "last_event"])
    first = history.rows[0]["number"] if history.rows else 0
    if first > station.last_event + 1:
        log.error(
            "events %d to %d of %s are lost: `manage.py reconcile` finds the episodes",
            station.last_event + 1,
            first - 1,
            station,
        )
    for event in history.after(station.last_event):
        if event["kind"] in NOTED:
            _hand_on(station, history.boot, event)
            _advance(station, history.boot, event["number"])
    _advance(station, history.boot, history.newest)
    return history.boot, history.newest


def _restarted(history: History, state: str) -> dict[str, Any]:
    text = f"restarted -> {state}: the station was restarted"
    return {
        "number": 0,
        "kind": "state",
        "text": text,
        "time": None,
        "data": {"state": state},
        "boot": history.boot,
    }


def _advance(station: Station, boot: str, number: int) -> None:
    """Record the number of the last event, unless another process is further ahead."""
    if number > station.last_event:
        Station.objects.filter(Q(pk=station.pk, boot=boot, last_event__lt=number)).update(last_event=number)
        station.last_event = number


def _hand_on(station: Station, boot: str, event: Mapping[str, Any]) -> None:
    """Pass one event to the services.

    A failure of a service is logged, so that it does not block later events; database errors are raised.
    """
    unbegun = event["data"].get("unbegun") or {}
    try:
        if event["kind"] == "episode_closed":
            episodes.record_closed(station=station, data=event["data"])
        if unbegun.get("unopened"):
            commands.record_run_not_opened(station=station, uuid=unbegun["command"], reason=event["text"])
        trials.apply_station_event(station=station, event=event, boot=boot)
        if unbegun.get("unopened"):
            episodes.forget_unopened(station=station, uuid=unbegun["episode"])
        if event["kind"] in collect.TOLD:
            collect.apply_station_event(event=event)
    except Error:
        raise
    except Exception:
        log.exception("event %s of %s (%s) is not in the database", event["number"], station, event["text"])


class EventIngest:
    """Ingesters of all stations, including stations that are added later."""

    def __init__(self, heard: Feeds = feeds) -> None:
        self._feeds = heard
        self._scribes: dict[str, StationEventIngester] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="events", daemon=True)

    def start(self) -> None:
        """Start the thread; returns at once."""
        self._thread.start()

    def end(self) -> None:
        """Stop all ingesters."""
        self._ended.set()
        for scribe in self._scribes.values():
            scribe.end()

    def _run(self) -> None:
        failing = False
        while not self._ended.is_set():
            commands.unwritten.start_writing()
            try:
                self._update_stations()
                failing = False
            except Error as error:
                if not failing:
                    log.warning("the database does not say which stations there are: %s", error)
                failing = True
            self._ended.wait(2 * _TURN_S)

    def _update_stations(self) -> None:
        close_old_connections()
        try:
            names = list(Station.objects.values_list("name", flat=True))
        finally:
            close_old_connections()
        for name in names:
            if name not in self._scribes and not self._ended.is_set():
                self._scribes[name] = StationEventIngester(name, self._feeds)
                self._scribes[name].start()
