"""Preflights of every protocol against its stand-in, in one process."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from robots import Robot
from runtime.config import loader
from runtime.preflight.report import Report
from runtime.preflight.runner import PreflightRunner
from runtime.standins.faults import NONE, Fault
from runtime.station.checks import check_deployment
from runtime.station.spec import StationSpec
from tests.runtime.policies.peers import FRANKA, PIPER

SIZE = (24, 32)
CAMERAS = [camera.key for camera in FRANKA.cameras]
PARTS = {group.name: list(range(group.slice.start, group.slice.stop)) for group in PIPER.groups}
VIEWS = {camera.key: camera.key for camera in PIPER.cameras}
PATIENT = {"connect_deadline": 20.0, "first_inference_deadline": 30.0, "inference_deadline": 20.0}
HURRIED = {"connect_deadline": 0.5, "first_inference_deadline": 0.5, "inference_deadline": 0.5}


@dataclass(frozen=True)
class Wire:
    """A protocol: the policy's settings, its robot, its stand-in with a fault."""

    settings: dict[str, Any]
    server: Callable[[Fault], Any]
    robot: Robot = FRANKA
    groups: list[str] | None = field(default_factory=lambda: ["left_arm"])


def _openpi(fault: Fault) -> Any:
    from runtime.standins.openpi_server import Behaviour, OpenpiServer

    return OpenpiServer(FRANKA, Behaviour(fault=fault))


def _arena(variant: Any) -> Callable[[Fault], Any]:
    from runtime.standins.roboarena_server import RoboarenaBehaviour, RoboarenaServer

    return lambda fault: RoboarenaServer(
        FRANKA, RoboarenaBehaviour(fault=fault, variant=variant, resolution=SIZE)
    )


def _starvla(old: bool) -> Callable[[Fault], Any]:
    from runtime.standins.starvla_server import StarvlaBehaviour, StarvlaServer

    return lambda fault: StarvlaServer(FRANKA, StarvlaBehaviour(fault=fault, size=SIZE, old=old))


def _xpolicylab(fault: Fault) -> Any:
    from runtime.standins.xpolicylab_server import XpolicylabBehaviour, XpolicylabServer

    return XpolicylabServer(FRANKA, XpolicylabBehaviour(fault=fault))


def _gr00t(version: Any) -> Callable[[Fault], Any]:
    from runtime.standins.gr00t_server import Gr00tBehaviour, Gr00tServer

    return lambda fault: Gr00tServer(PIPER, Gr00tBehaviour(version, fault=fault))


def _lerobot(fault: Fault) -> Any:
    from runtime.standins.lerobot_server import LerobotBehaviour, LerobotServer

    return LerobotServer(PIPER, LerobotBehaviour(fault=fault, patience=0.1))


ARENA = {
    "kind": "roboarena",
    "cameras": {"cam_high": "first", "cam_left_wrist": "wrist"},
    "reset_deadline": 5.0,
}
STARVLA = {"kind": "starvla", "cameras": CAMERAS, "ping_every": 0}
XPOLICYLAB = {
    "kind": "xpolicylab",
    "cameras": {"cam_high": "cam_head", "cam_left_wrist": "cam_wrist"},
    "heartbeat_every": 0,
}
STATISTICS = {"low": list(FRANKA.lower), "high": list(FRANKA.upper)}
GROOT = {"kind": "gr00t", "video": VIEWS, "state": PARTS, "actions": PARTS}
LEROBOT = {
    "kind": "lerobot",
    "accept_pickle": True,
    "policy_type": "act",
    "checkpoint": "user/ckpt",
    "images": VIEWS,
}
WIRES = {
    "openpi": Wire({"kind": "openpi"}, _openpi),
    "roboarena": Wire(ARENA, _arena("roboarena")),
    "vllm": Wire(ARENA, _arena("vllm")),
    "starvla": Wire(STARVLA, _starvla(old=False)),
    "starvla-old": Wire({**STARVLA, "statistics": STATISTICS}, _starvla(old=True)),
    "xpolicylab": Wire(XPOLICYLAB, _xpolicylab),
    "gr00t-n1.5": Wire({**GROOT, "dialect": "n1.5"}, _gr00t("n1.5"), PIPER, None),
    "gr00t-n1.6": Wire({**GROOT, "dialect": "nested"}, _gr00t("n1.6"), PIPER, None),
    "gr00t-n1.7-early": Wire(GROOT, _gr00t("n1.7-early"), PIPER, None),
    "gr00t-starvla": Wire(GROOT, _gr00t("starvla"), PIPER, None),
    "lerobot": Wire(LEROBOT, _lerobot, PIPER, None),
}


def planned(wire: Wire, url: str, settings: Mapping[str, Any] | None = None, **tables: Any) -> StationSpec:
    """A plan whose policy is that of the wire, at `url`."""
    tree = {
        "station": "bench-1",
        "robot": wire.robot.name,
        "groups": wire.groups,
        "task": "pick the block",
        "transport": {"kind": "zmq"},
        "policy": {**wire.settings, **PATIENT, "url": url, **(settings or {})},
        **tables,
    }
    return check_deployment(loader.resolve_deployment(tree, {}, "test"))


@contextlib.contextmanager
def served(name: str, fault: Fault = NONE) -> Iterator[str]:
    """The address of the wire's stand-in."""
    with contextlib.closing(WIRES[name].server(fault)) as server:
        yield str(server.start()["url"])


def flown(name: str, fault: str = "", deadline: float = 60.0, **settings: Any) -> Report:
    """The report about a stand-in with a fault NAME[:ARG]."""
    kind, _, argument = fault.partition(":")
    with served(name, Fault(kind, argument) if fault else NONE) as url:
        return PreflightRunner(planned(WIRES[name], url, settings)).run(deadline)
