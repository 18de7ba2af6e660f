"""Round trip of each policy protocol with its stand-in server, which is a separate process.

Every request is a complete `infer`: three 224x224 images and 14 joints are sent, 50 rows of 14 numbers are received and
checked. The published `openpi-client` sends the same observation to the same server, alternating with our client. It is
given views of the same images, as in its own examples.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import numpy as np

import robots
from benchmarks.labs import ROOT
from benchmarks.wires_relay import Relay
from robots import Robot
from runtime.core import process_limits as heap
from runtime.core.clock import MonotonicClock
from runtime.core.errors import ConfigurationError
from runtime.core.plugins import variants
from runtime.core.types import Observation
from runtime.policies.base import Policy

ROBOT = "agilex_piper"  # two arms of seven numbers, three cameras
PICTURE = (224, 224, 3)
HORIZON = 50
RATE = 30.0
WARM = 20  # requests before the measurement
_WEIGHED = 20  # requests whose bytes are counted
_ROUNDS = 8
_PATIENCE_S = 30.0
Row = dict[str, Any]
Ask = Callable[[], object]
Opened = AbstractContextManager[Ask]
Opening = Callable[[], Opened]
_PEER = "openpi-client"


@dataclass(frozen=True, slots=True)
class Protocol:
    """Policy protocol to measure.

    `name` is its name in `runtime.standins.serve`. `settings` are the settings of our client, and `options` the options
    of the stand-in server.
    """

    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    options: Sequence[str] = ()


def protocols(robot: Robot) -> list[Protocol]:
    """Return all measured protocols, each with three images and the joints of `robot`."""
    keys = [camera.key for camera in robot.cameras]
    places = {group.name: list(range(group.slice.start, group.slice.stop)) for group in robot.groups}
    pictures = {key: key for key in keys}
    return [
        Protocol("openpi"),
        Protocol(
            "roboarena",
            {
                "cameras": dict(zip(keys, ("first", "second", "wrist"), strict=True)),
                "gripper": "robot",
                "cartesian_position": "zeros",
            },
            ("--externals", "2"),
        ),
        Protocol("starvla", {"cameras": keys}),
        Protocol(
            "xpolicylab",
            {"cameras": dict(zip(keys, ("cam_head", "cam_left_wrist", "cam_right_wrist"), strict=True))},
        ),
        Protocol("gr00t", {"video": pictures, "state": places, "actions": places}),
        Protocol(
            "lerobot",
            {"accept_pickle": True, "policy_type": "act", "checkpoint": "stand-in", "images": pictures},
        ),
    ]


def measure(seconds: float) -> list[Row]:
    """Return a row per protocol, each measured for `seconds`.

    openpi is measured for twice as long, because it alternates with the published client.
    """
    heap.keep_freed_memory()  # as in the coordinator
    robot = robots.load_robot(ROBOT)
    return [_case(protocol, robot, seconds) for protocol in protocols(robot)]


def _case(protocol: Protocol, robot: Robot, seconds: float) -> Row:
    reason = absent(protocol, robot)
    if reason:
        return {"protocol": protocol.name, "absent": reason}
    sample = observation(robot)
    peer, missing = _peer(sample) if protocol.name == "openpi" else (None, "")
    with _server(protocol) as url:
        opened: list[Opening] = [lambda: _ours(protocol, robot, url, sample)]
        opened += [] if peer is None else [lambda: peer(url)]
        rounds = [_round(opened, len(opened) * seconds / _ROUNDS) for _ in range(_ROUNDS)]
        weighed = _weighed(protocol, robot, url, sample)
    own = Timed.joined([pair[0] for pair in rounds])
    row: Row = {"protocol": protocol.name, "requests": len(own.round_trips), **own.row(), **weighed}
    if peer is not None:
        reference = Timed.joined([pair[1] for pair in rounds]).row()
        row["peer"] = {"name": _PEER, "version": importlib.metadata.version(_PEER), **reference}
        row["ratio"] = float(np.median([mine.median / compared.median for mine, compared in rounds]))
    elif missing:
        row["peer_absent"] = missing
    return row


def _round(opened: Sequence[Opening], seconds: float) -> list[Timed]:
    """Measure each client for `seconds` with a new connection.

    Several rounds are needed, because the placement of a connection's threads on processors is random.
    """
    with contextlib.ExitStack() as stack:
        return in_turn([stack.enter_context(opening()) for opening in opened], seconds)


@contextlib.contextmanager
def _ours(protocol: Protocol, robot: Robot, url: str, sample: Observation) -> Iterator[Ask]:
    with contextlib.closing(_policy(protocol, robot, url)) as policy:
        policy.connect()
        yield lambda: policy.infer(sample)


@dataclass(slots=True)
class Timed:
    """Measurements of one client: round trips [s], and processor time per turn [s]."""

    round_trips: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)

    @classmethod
    def joined(cls, parts: Sequence[Timed]) -> Timed:
        return cls(
            [duration for part in parts for duration in part.round_trips],
            [duration for part in parts for duration in part.processor],
        )

    @property
    def median(self) -> float:
        return float(np.median(self.round_trips))

    def row(self) -> Row:
        """Return the measurements as a row; `cpu_ms` is this process's processor time per request, with all threads."""
        percentiles = {f"p{q}": 1e3 * float(np.percentile(self.round_trips, q)) for q in (50, 99)}
        return {"round_trip_ms": percentiles, "cpu_ms": 1e3 * float(np.mean(self.processor))}


def in_turn(
    asks: Sequence[Ask], seconds: float, clock: Callable[[], float] = time.perf_counter
) -> list[Timed]:
    """Call each of `asks` in turn after a warm-up, in reversed order every second time; return the measurements."""
    for _ in range(WARM):
        for ask in asks:
            ask()
    timings = [Timed() for _ in asks]
    order = list(range(len(asks)))
    end = clock() + seconds
    while clock() < end:
        for index in order:
            used, begun = time.process_time(), clock()
            asks[index]()
            timings[index].round_trips.append(clock() - begun)
            timings[index].processor.append(time.process_time() - used)
        order.reverse()
    return timings


def observation(robot: Robot) -> Observation:
    """Return an observation with joints at 0.1 and three noise images."""
    random = np.random.default_rng(0)
    pictures = {camera.key: random.integers(0, 256, PICTURE, np.uint8) for camera in robot.cameras}
    for picture in pictures.values():
        picture.flags.writeable = False
    return Observation(1, 0.0, {}, np.full(robot.dim, 0.1, np.float32), pictures, prompt="pick the block")


def absent(protocol: Protocol, robot: Robot) -> str:
    """Return why a protocol cannot be measured on this machine, "" if it can."""
    try:
        _policy(protocol, robot)
    except ConfigurationError as error:
        return str(error)
    return ""


def _policy(protocol: Protocol, robot: Robot, url: str | None = None) -> Policy:
    module = variants("runtime.policies")[protocol.name]
    where = {} if url is None else {"url": url}
    policy: Policy = module.build(module.Config(**where, **protocol.settings), robot, MonotonicClock(), RATE)
    return policy


def _peer(sample: Observation) -> tuple[Callable[[str], Opened] | None, str]:
    """Return a function that opens the published client of openpi, and "".

    That client sends the same requests as our policy. If it is not installed, return None and the reason.
    """
    try:
        from openpi_client.websocket_client_policy import WebsocketClientPolicy
    except ImportError as error:
        return None, f"{_PEER} is not installed ({error}): pip install --no-deps {_PEER}"

    @contextlib.contextmanager
    def opened(url: str) -> Iterator[Ask]:
        client = WebsocketClientPolicy(url)

        def ask() -> object:
            views = {key: picture.transpose(2, 0, 1) for key, picture in sample.pictures.items()}
            return client.infer({"state": sample.qpos, "images": views, "prompt": sample.prompt})

        yield ask
        client._ws.close()  # it has no public method

    return opened, ""


def _weighed(protocol: Protocol, robot: Robot, url: str, sample: Observation) -> Row:
    """Return the bytes per request and per answer, with all overhead of the protocol, counted by a relay."""
    place = urlsplit(url)
    assert place.port is not None
    with Relay(place.port) as relay:
        relayed = place._replace(netloc=f"127.0.0.1:{relay.port}").geturl()
        with contextlib.closing(_policy(protocol, robot, relayed)) as policy:
            policy.connect()
            policy.infer(sample)
            before = relay.settled()
            for _ in range(_WEIGHED):
                policy.infer(sample)
            out, back = (now - then for now, then in zip(relay.settled(), before, strict=True))
    return {"request_bytes": out / _WEIGHED, "answer_bytes": back / _WEIGHED}


@contextlib.contextmanager
def _server(protocol: Protocol) -> Iterator[str]:
    """Yield the address of a stand-in server in a separate process."""
    command = [sys.executable, "-m", "runtime.standins.serve", protocol.name, "--robot", ROBOT, "--port", "0"]
    command += ["--horizon", str(HORIZON), "--rate", str(RATE), "--lifeline", *protocol.options]
    child = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        line = child.stdout.readline()
        if not line:
            raise SystemExit(f"the stand-in for {protocol.name} ended with {child.wait()}")
        yield json.loads(line)["url"]
    finally:
        child.stdin.close()
        child.wait(_PATIENCE_S)
