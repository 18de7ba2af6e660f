"""Common parts of simulation and stand-in programs: options, announcement of addresses, orderly end."""

from __future__ import annotations

import argparse
import json
import os
import signal
import threading
from collections.abc import Mapping
from pathlib import Path

from runtime.core.durable_files import write_durably


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that all these programs share."""
    parser.add_argument(
        "--ready-file", type=Path, help="write the addresses there as JSON, once they are open"
    )
    parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")


def names(text: str) -> list[str]:
    """Return the names in a text in which commas separate them."""
    return [name.strip() for name in text.split(",")]


def announce_ready(ready: Mapping[str, object], path: Path | None) -> None:
    """Write the addresses to `path` atomically, then print them as one JSON line."""
    line = json.dumps(dict(ready))
    if path is not None:
        write_durably(path, f"{line}\n".encode())
    print(line, flush=True)


def stop_event(lifeline: bool) -> threading.Event:
    """Return an event that is set by SIGTERM and SIGINT, and with `lifeline` also by the end of standard input.

    Call it in the main thread.
    """
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    if lifeline:
        threading.Thread(target=_watch, args=(stop,), name="lifeline", daemon=True).start()
    return stop


def _watch(stop: threading.Event) -> None:
    while os.read(0, 4096):
        pass
    stop.set()
