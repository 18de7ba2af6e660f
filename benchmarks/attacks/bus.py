"""Attack by a client that floods a station with requests, and ignores the answers."""

from __future__ import annotations

import threading
from collections import Counter
from uuid import uuid4

import zmq

from benchmarks.attacks.target import Target
from benchmarks.estop_lab import PRESSED
from runtime.ipc.bus import CommandClient, Endpoints
from runtime.ipc.messages import Command

_SOCKETS = (("coordinator", "commands"), ("guard", "estop"))


def status_flood(target: Target) -> Counter[str]:
    """Request the status of coordinator and guard as fast as their sockets accept it."""
    sent: Counter[str] = Counter()
    for process, key in _SOCKETS:
        threading.Thread(target=_flood, args=(target, process, key, sent), daemon=True).start()
    target.begun()
    target.ended.wait()
    return sent


def _flood(target: Target, process: str, key: str, sent: Counter[str]) -> None:
    endpoints = Endpoints(target.data / "stations" / PRESSED)
    client = CommandClient(zmq.Context.instance(), endpoints.read(process)[key])
    while not target.ended.is_set():
        client.send(Command(str(uuid4()), "status"))  # blocks while the queue is full
        sent[process] += 1
