"""Policy servers that sometimes answer twice: no answer may be mistaken for the answer to another request."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import robots
from robots import Robot
from runtime.core.clock import MonotonicClock
from runtime.core.errors import PolicyError
from runtime.core.plugins import variants
from runtime.core.types import Observation
from runtime.policies.base import Policy
from runtime.standins.openpi_server import Behaviour, OpenpiServer
from runtime.standins.roboarena_server import RoboarenaBehaviour, RoboarenaServer
from runtime.standins.starvla_server import StarvlaBehaviour, StarvlaServer
from runtime.standins.websocket_server import Frames, WebsocketServer
from runtime.standins.xpolicylab_server import XpolicylabBehaviour, XpolicylabServer

_QUESTIONS = 12
_SIZE = (24, 32)  # of images
_NEAR = 0.05  # [rad] tolerance between the observed joints and the start of a chunk
_ARENA = {"cameras": {"cam_high": "first", "cam_left_wrist": "wrist"}, "cartesian_position": "zeros"}
_ROBOT = robots.load_robot("dual_franka", ["left_arm"])
_VIEWS = [camera.key for camera in _ROBOT.cameras]


@dataclass(frozen=True, slots=True)
class Protocol:
    """Protocol under test: kind and settings of the client, and function that makes the server."""

    kind: str
    server: Callable[[], WebsocketServer]
    settings: dict[str, Any] = field(default_factory=dict)


_PROTOCOLS = (
    Protocol("openpi", lambda: OpenpiServer(_ROBOT, Behaviour())),
    Protocol("openpi", lambda: OpenpiServer(_ROBOT, Behaviour(rtc="async_rtc")), {"rtc": "async_rtc"}),
    Protocol("roboarena", lambda: RoboarenaServer(_ROBOT, RoboarenaBehaviour(resolution=_SIZE)), _ARENA),
    Protocol(
        "roboarena",
        lambda: RoboarenaServer(_ROBOT, RoboarenaBehaviour(variant="vllm", reply="dict", resolution=_SIZE)),
        _ARENA,
    ),
    Protocol(
        "starvla",
        lambda: StarvlaServer(_ROBOT, StarvlaBehaviour(size=_SIZE)),
        {"cameras": _VIEWS, "ping_every": 0},
    ),
    Protocol(
        "xpolicylab",
        lambda: XpolicylabServer(_ROBOT, XpolicylabBehaviour()),
        {"cameras": {"cam_high": "cam_head"}, "heartbeat_every": 0},
    ),
)


def once(seed: int) -> list[str]:
    """Send requests to a server whose protocol `seed` determines; return each violation as a sentence."""
    random = np.random.default_rng(seed)
    chosen = _PROTOCOLS[int(random.integers(len(_PROTOCOLS)))]
    values = random.permutation(np.linspace(0.1, 1.3, _QUESTIONS))
    server = chosen.server()
    doubled = _doubling(server, random)
    with closing(server):
        url = str(server.start()["url"])
        module = variants("runtime.policies")[chosen.kind]
        config = module.Config(url=url, connect_deadline=10.0, inference_deadline=10.0, **chosen.settings)
        with closing(module.build(config, _ROBOT, MonotonicClock(), 30.0)) as policy:
            problems = _asked(policy, values)
    wrong = [text for text in problems if not text.startswith("error")]
    failed = len(problems) - len(wrong)
    if failed > doubled():
        wrong.append(f"{failed} questions failed for {doubled()} doubled answers: {problems}")
    return [f"seed {seed}: {chosen.kind}: {text}" for text in wrong]


def _asked(policy: Policy, values: np.ndarray[Any, Any]) -> list[str]:
    """Return the violations found when `policy` is asked about each of `values` in turn."""
    problems: list[str] = []
    for value in values.tolist():
        near = np.clip(value, _ROBOT.lower, _ROBOT.upper)
        try:
            begins = policy.infer(_seen(_ROBOT, value)).actions[0]
        except PolicyError as error:
            problems.append(f"error: {error}")
            continue
        off = float(np.abs(begins - near).max())
        if off >= _NEAR:
            problems.append(f"the question about {value:.2f} has an answer that begins {off:.2f} away")
    return problems


def _doubling(server: WebsocketServer, random: np.random.Generator) -> Callable[[], int]:
    """Make the server repeat some answers, at once or at the next request.

    Return a function that returns the number of repeated answers.
    """
    send, before, count = server._send, dict[Any, Frames](), 0

    def sending(connection: Any, reply: Frames, number: int) -> bool:
        nonlocal count
        last = before.get(connection)
        if last is not None and random.random() < 0.2:
            connection.send(last)
            count += 1
        went = send(connection, reply, number)
        if random.random() < 0.2:
            connection.send(reply)
            count += 1
        before.clear()
        before[connection] = reply
        return went

    server._send = sending  # type: ignore[method-assign]
    return lambda: count


def _seen(robot: Robot, value: float) -> Observation:
    pictures = {camera.key: np.zeros((*_SIZE, 3), np.uint8) for camera in robot.cameras}
    return Observation(1, 0.0, {}, np.full(robot.dim, value, np.float32), pictures, prompt="pick")
