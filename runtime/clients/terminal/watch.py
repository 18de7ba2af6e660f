"""Display of a station's activity: figures as they change, and every event."""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

from runtime.clients.client import StationClient
from runtime.clients.terminal.status_text import status_line
from runtime.ipc.session_state import complete_state_meaning

_SHOW_S = 0.5
_PATIENCE_S = 2.0


def watch(client: StationClient, as_json: bool) -> int:
    """Print figures and events until interrupted. Raises: TransportError if the station does not answer.

    The stream only wakes the loop; events are fetched by number, so that none is missed.
    """
    status = client.status()
    boot, newest_event, displayed_at = status["boot"], status["newest_event"], 0.0
    subscriber = client.subscribe("state")
    while True:
        message = subscriber.receive(_PATIENCE_S)
        if "state" in message:
            status = complete_state_meaning(message["state"])
        else:
            status = client.status()  # raises TransportError if the station is gone
            subscriber.close()
            subscriber = client.subscribe("state")  # a restarted station has new sockets
        if status["boot"] != boot:
            boot, newest_event = status["boot"], 0
        if status["newest_event"] > newest_event:
            for event in client.events_since(newest_event):
                print_event(event, as_json)
                newest_event = event["number"]
        if time.monotonic() - displayed_at > _SHOW_S:
            displayed_at = time.monotonic()
            print(
                json.dumps(status, default=str) if as_json else status_line(status, client.holder), flush=True
            )


def print_event(event: dict[str, Any], as_json: bool = False) -> None:
    """Print one event as a line."""
    print(json.dumps(event, default=str) if as_json else f"  {event['kind']}: {event['text']}", flush=True)


def list_events(client: StationClient, given: argparse.Namespace) -> int:
    """Print the events since the start of the station, each with its age."""
    now = client.status()["clock"]
    events = [
        event
        for event in client.events_since(given.since)
        if given.kind is None or event["kind"] in given.kind
    ]
    for event in events if given.last is None else events[-given.last or len(events) :]:
        if given.json:
            print_event(event, as_json=True)
        else:
            ago = f"{now - event['time']:8.1f} s ago"
            print(f"{event['number']:6} {ago}  {event['kind']}: {event['text']}")
    return 0
