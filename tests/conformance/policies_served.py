"""Every policy protocol: our client's settings, and how to start the stand-in for its server."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from robots import Robot
from runtime.core.clock import MonotonicClock
from runtime.core.plugins import variants
from runtime.policies.base import Policy
from runtime.standins.faults import NONE, Fault
from runtime.standins.gr00t_server import Gr00tBehaviour, Gr00tServer
from runtime.standins.openpi_server import Behaviour, OpenpiServer
from runtime.standins.roboarena_server import RoboarenaBehaviour, RoboarenaServer
from runtime.standins.serve import StandInServer
from runtime.standins.starvla_server import StarvlaBehaviour, StarvlaServer
from runtime.standins.xpolicylab_server import XpolicylabBehaviour, XpolicylabServer
from tests.runtime.policies.peers import FRANKA, PIPER, seen

SIZE = (48, 64)  # of the pictures of `seen`


@dataclass(frozen=True)
class Served:
    """A protocol: its `kind` of policy, settings, how its stand-in starts.

    `first` is the number of the request that first asks for rows, where others come before it.
    """

    kind: str
    scheme: str
    server: Callable[[Fault], StandInServer]
    robot: Robot = FRANKA
    settings: Mapping[str, Any] = field(default_factory=dict)
    first: int = 0

    @contextlib.contextmanager
    def policy(self, url: str, **own: Any) -> Iterator[Policy]:
        """Our client of the server at `url`."""
        module = variants("runtime.policies")[self.kind]
        config = module.Config(**{"url": url, "connect_deadline": 10.0, **self.settings, **own})
        made: Policy = module.build(config, self.robot, MonotonicClock(), 30.0)
        with contextlib.closing(made):
            yield made

    @contextlib.contextmanager
    def served(self, fault: Fault = NONE, **own: Any) -> Iterator[Policy]:
        """Our client of a stand-in with this fault."""
        with contextlib.closing(self.server(fault)) as server:
            url = str(server.start()["url"])
            with self.policy(url, **own) as policy:
                yield policy

    def begins_at(self, policy: Policy, value: float) -> bool:
        """Whether the answer is the one to an observation with all joints at `value`."""
        rows = policy.infer(seen(self.robot, value)).actions
        near = np.clip(value, self.robot.lower, self.robot.upper)
        return bool(np.abs(rows[0] - near).max() < 0.05)


def _arena(variant: str, reply: str) -> Callable[[Fault], StandInServer]:
    return lambda fault: RoboarenaServer(
        FRANKA,
        RoboarenaBehaviour(fault=fault, variant=variant, reply=reply, resolution=SIZE),  # type: ignore[arg-type]
    )


def _gr00t(version: Any) -> Served:
    parts = {group.name: list(range(group.slice.start, group.slice.stop)) for group in PIPER.groups}
    video = {camera.key: camera.key for camera in PIPER.cameras}
    dialect = "n1.5" if version == "n1.5" else "nested"
    settings = {"dialect": dialect, "video": video, "state": parts, "actions": parts}
    return Served(
        "gr00t",
        "tcp",
        lambda fault: Gr00tServer(PIPER, Gr00tBehaviour(version, fault=fault)),
        PIPER,
        settings,
    )


def _lerobot(fault: Fault) -> StandInServer:
    from runtime.standins.lerobot_server import LerobotBehaviour, LerobotServer

    return LerobotServer(PIPER, LerobotBehaviour(fault=fault, patience=0.1))


_ARENA = {"cameras": {"cam_high": "first", "cam_left_wrist": "wrist"}, "reset_deadline": 0.3}
_LEROBOT = {
    "accept_pickle": True,
    "policy_type": "act",
    "checkpoint": "user/ckpt",
    "images": {camera.key: camera.key for camera in PIPER.cameras},
}
WEBSOCKETS = {
    "openpi": Served("openpi", "ws", lambda fault: OpenpiServer(FRANKA, Behaviour(fault=fault))),
    "roboarena": Served("roboarena", "ws", _arena("roboarena", "bare"), settings=_ARENA),
    "vllm": Served("roboarena", "ws", _arena("vllm", "dict"), settings=_ARENA),
    "starvla": Served(
        "starvla",
        "ws",
        lambda fault: StarvlaServer(FRANKA, StarvlaBehaviour(fault=fault, size=SIZE)),
        settings={"cameras": [camera.key for camera in FRANKA.cameras], "ping_every": 0},
        first=1,  # a ping
    ),
    "starvla-old": Served(
        "starvla",
        "ws",
        lambda fault: StarvlaServer(FRANKA, StarvlaBehaviour(fault=fault, old=True)),
        settings={
            "cameras": [camera.key for camera in FRANKA.cameras],
            "ping_every": 0,
            "statistics": {"low": list(FRANKA.lower), "high": list(FRANKA.upper)},
        },
        first=1,
    ),
    "xpolicylab": Served(
        "xpolicylab",
        "ws",
        lambda fault: XpolicylabServer(FRANKA, XpolicylabBehaviour(fault=fault)),
        settings={
            "cameras": {"cam_high": "cam_head", "cam_left_wrist": "cam_wrist"},
            "heartbeat_every": 0,
            "reset_deadline": 0.3,
        },
        first=2,  # a hello and a reset
    ),
}
PROTOCOLS = WEBSOCKETS | {
    "gr00t-n1.5": _gr00t("n1.5"),
    "gr00t-n1.6": _gr00t("n1.6"),
    "gr00t-n1.7": _gr00t("n1.7"),
    "gr00t-n1.7-early": _gr00t("n1.7-early"),
    "gr00t-starvla": _gr00t("starvla"),
    "lerobot": Served("lerobot", "grpc", _lerobot, PIPER, _LEROBOT),
}


def protocol(name: str) -> Served:
    """The protocol; skips the test where a package for it is missing."""
    if name == "lerobot":
        pytest.importorskip("grpc", reason="the extra lerobot-grpc is not installed")
    return PROTOCOLS[name]
