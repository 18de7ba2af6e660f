"""`python -m runtime.ctl STATION COMMAND`: command and watch a station from a terminal."""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from runtime.client import Refused, StationClient
from runtime.errors import RuntimeFault

# Commands that go on after they were accepted: the terminal stays, keeps the lease, and Ctrl-C stops.
_LASTING = {"setup": ("setting_up",), "home": ("setting_up",), "run": ("running",), "resume": ("running",)}
_AT_ONCE = ("stop", "halt", "release")
_GOOD_END = "ready"
_OPTIONS = {"policy_url": "setup", "task": "setup", "duration": "run"}  # by the command they go with


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code 0 where the command was done, 1 where it was refused or failed."""
    parser = argparse.ArgumentParser(prog="python -m runtime.ctl", description=__doc__)
    parser.add_argument("station")
    parser.add_argument("command", choices=[*_LASTING, *_AT_ONCE, "estop", "status", "watch", "record"])
    parser.add_argument("what", nargs="?", help="record: start or stop; estop: why")
    parser.add_argument("--data-dir", default=os.environ.get("EVA_DATA_DIR") or "data")
    parser.add_argument("--policy-url", metavar="URL", help="setup: another server than the deployment's")
    parser.add_argument("--task", help="setup: another instruction than the deployment's")
    parser.add_argument(
        "--duration", type=float, metavar="S", help="run: seconds after which it ends by itself"
    )
    parser.add_argument("--json", action="store_true", help="status and watch as JSON")
    given = parser.parse_args(arguments)
    if given.command == "record" and given.what not in ("start", "stop"):
        parser.error("record needs start or stop")
    for option, command in _OPTIONS.items():
        if getattr(given, option) is not None and given.command != command:
            parser.error(f"--{option.replace('_', '-')} goes with {command}, not with {given.command}")
    client = StationClient(Path(given.data_dir).expanduser().absolute() / "stations" / given.station)
    try:
        return _do(client, given)
    except Refused as refusal:
        print(f"refused: {refusal}", file=sys.stderr)
    except RuntimeFault as fault:
        print(f"error: {fault}", file=sys.stderr)
    except KeyboardInterrupt:
        return 130
    finally:
        client.close()
    return 1


def _do(client: StationClient, given: argparse.Namespace) -> int:
    if given.command == "estop":
        ack = client.estop(given.what or "pressed in a terminal")
        print(f"{ack.status}: {ack.reason}")
        return 0 if ack.status == "done" else 1
    if given.command == "status":
        status = client.status()
        print(json.dumps(status, indent=1, default=str) if given.json else line(status, client.holder))
        return 0
    if given.command == "watch":
        return _watch(client, given.json)
    if given.command == "record":
        client.command(f"record_{given.what}")
    elif given.command in _AT_ONCE:
        client.command(given.command)
    else:
        return _attend(client, given.command, _arguments(given))
    print(line(client.status()))
    return 0


def _arguments(given: argparse.Namespace) -> dict[str, Any]:
    """What goes with the command, without what was not said."""
    policy = None if given.policy_url is None else {"url": given.policy_url}
    said = {"policy": policy, "task": given.task, "duration_s": given.duration}
    return {name: value for name, value in said.items() if value is not None}


def _attend(client: StationClient, kind: str, arguments: dict[str, Any]) -> int:
    """Give a lasting command and stay with it: the lease lives as long as this terminal."""
    pressed = threading.Event()
    # An exception out of nowhere can be lost in a destructor; a Ctrl-C that stops a robot must not be.
    before = signal.signal(signal.SIGINT, lambda *_: pressed.set())
    try:
        client.command(kind, **arguments)
        status = client.status()
        shown = 0.0
        while status["state"] in _LASTING[kind]:
            if pressed.is_set():
                raise KeyboardInterrupt
            client.renew()
            if time.monotonic() - shown > 0.5:
                shown = time.monotonic()
                print(line(status), flush=True)
            time.sleep(0.05)
            status = client.status()
    except KeyboardInterrupt:
        client.command("stop")
        status = client.status()
    finally:
        signal.signal(signal.SIGINT, before)
    print(line(status))
    return 0 if status["state"] == _GOOD_END else 1


def _watch(client: StationClient, as_json: bool) -> int:
    """Print until interrupted; the stream only wakes, events are fetched by number so that none is missed."""
    status = client.status()
    boot, seen, shown = status["boot"], status["newest_event"], 0.0
    subscriber = client.subscribe("state")
    while True:
        status = subscriber.receive(2.0).get("state", {})
        if not status:
            status = client.status()  # raises a sentence where the station is gone
            subscriber.close()
            subscriber = client.subscribe("state")  # a restarted one has other sockets
        if status["boot"] != boot:
            boot, seen = status["boot"], 0
        if status["newest_event"] > seen:
            seen = _print_events(client, seen, as_json)
        if time.monotonic() - shown > 0.5:
            shown = time.monotonic()
            print(json.dumps(status, default=str) if as_json else line(status, client.holder), flush=True)


def _print_events(client: StationClient, after: int, as_json: bool) -> int:
    for event in client.events_since(after):
        print(
            json.dumps(event, default=str) if as_json else f"  {event['kind']}: {event['text']}", flush=True
        )
        after = event["number"]
    return after


def line(status: dict[str, Any], me: str | None = None) -> str:
    """One line for a person; with `me`, a lease that somebody else holds is named too."""
    stage = f" ({status['stage']})" if status["state"] == "setting_up" else ""
    reason = f": {status['reason']}" if status["reason"] else ""
    parts = [f"{status['state'].upper()}{stage}{reason}", *_run_figures(status), *_tick_figures(status)]
    holder = status["lease"]["holder"]
    if me is not None and holder not in ("", me):
        parts.append(f"lease: {holder}")
    return "  ".join(parts)


def _run_figures(status: dict[str, Any]) -> list[str]:
    parts = []
    if status["run"]["number"]:
        parts.append(f"{status['run']['elapsed']:.1f} s")
    if status["recording"]["uuid"]:
        parts.append(f"{status['recording']['rows']} rows")
    policy = status["policy"]
    if not math.isnan(policy["latency_p50_ms"]):
        parts.append(f"policy {policy['latency_p50_ms']:.0f} ms, delay {figure(policy['delay_p50'])}")
    return parts


def _tick_figures(status: dict[str, Any]) -> list[str]:
    control = status["control"]
    parts = [f"tick p99 {control['lateness_p99_ms']:.2f} ms, {control['missed']} missed"]
    rates = [rate for name, rate in status["link"]["rates"].items() if name not in ("joints", "eef")]
    if rates:
        parts.append(f"cameras {min(rates):.0f} Hz")  # the slowest
    return parts


def figure(value: float) -> str:
    """A whole number, or a dash for what has not been measured."""
    return "-" if math.isnan(value) else f"{value:.0f}"


if __name__ == "__main__":
    sys.exit(main())
