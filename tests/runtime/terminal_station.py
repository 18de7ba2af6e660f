"""A station of the terminal's tests: it answers as written down."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

from runtime.ipc.messages import Ack
from tests.standing import state_flags

STATUS: dict[str, Any] = {
    "boot": "boot-1",
    "station": "bench-1",
    "robot": "toy",
    "transport": "zmq",
    **state_flags("ready"),
    "reason": "set up",
    "allowed": ["setup", "run", "estop"],
    "stage": "idle",
    "mode": "continuous",
    "sim_state": "simulated",
    "phase": "",
    "task": "fold",
    "strategy": "async",
    "tuning": {"kind": "async", "k_max": None, "blend_window": 8, "ensemble_m": 0.01},
    "first_action": {},
    "proposal": {},
    "grippers": {"left": {"locked": True, "at": 0.05}, "right": {"locked": False, "at": 0.1}},
    "drives": {},
    "newest_event": 0,
    "clock": 100.0,
    "control": {"lateness_p99_ms": 0.5, "missed": 2, "step": 0, "behaviour": "hold"},
    "policy": {
        "kind": "openpi",
        "name": "pi0",
        "answers": 0,
        "latency_p50_ms": math.nan,
        "latency_p90_ms": math.nan,
        "delay_p50": math.nan,
        "delay_max": math.nan,
        "lost": False,
        "retry_in_s": 0.0,
        "rtc": {"predicted_delay": 0, "conditioned": False, "warning": ""},
    },
    "link": {"rates": {"joints": 30.0}},
    "run": {"number": 0, "elapsed": 0.0},
    "recording": {"uuid": "", "rows": 0},
    "lease": {"holder": "", "expires_in": 0.0},
    "facts": {
        "joint_names": ["a", "b", "grip"],
        "strategies": {"async": ["blend_window", "k_max"], "sync": ["execution_horizon"]},
    },
}
AIM: dict[str, Any] = {
    "joints": [0.1, -0.2, 0.05],
    "poses": [0.0] * 8,
    "reached": True,
    "position_error_mm": 0.0,
    "rotation_error_deg": 0.0,
    "clipped": [],
    "distance": 0.2,
    "duration_s": 1.5,
}


def status(state: str = "ready", **changes: Any) -> dict[str, Any]:
    return deepcopy(STATUS) | state_flags(state) | changes


class Script:
    """One status after the other, the last for ever; an exception is raised."""

    holder = "terminal:me"

    def __init__(
        self,
        statuses: Iterable[dict[str, Any] | BaseException] = (),
        refusal: BaseException | None = None,
        streams: Iterable[dict[str, Any] | BaseException] = (),
        events: Iterable[dict[str, Any]] = (),
        aims: Iterable[Mapping[str, Any]] = (),
    ) -> None:
        self.statuses, self.refusal, self.streams = list(statuses) or [status()], refusal, list(streams)
        self.events, self.aims = list(events), list(aims)
        self.given: list[str | tuple[str, Any]] = []
        self.asked: list[dict[str, Any]] = []
        self.subscribed, self.closed = 0, False

    def __call__(self, folder: Path) -> Script:
        self.folder = folder
        return self

    def status(self) -> dict[str, Any]:
        found = self.statuses.pop(0) if len(self.statuses) > 1 else self.statuses[0]
        if isinstance(found, BaseException):
            raise found
        return found

    def command(self, kind: str, **arguments: Any) -> None:
        self.given.append((kind, arguments) if arguments else kind)
        if self.refusal:
            raise self.refusal

    def query(self, kind: str, **arguments: Any) -> Ack:
        self.asked.append(arguments)
        wanted = self.aims.pop(0) if arguments and self.aims else AIM
        return Ack("u", "done", data=wanted)

    def renew(self) -> None:
        self.given.append("renew")

    def wait(self, reached: Callable[[dict[str, Any]], bool], timeout: float) -> dict[str, Any]:
        while not reached(found := self.status()):
            pass
        return found

    def estop(self, why: str) -> Ack:
        self.given.append(("estop", why))
        return Ack(
            "u", "failed" if self.refusal else "done", "USE THE HARDWARE STOP" if self.refusal else "ok"
        )

    def subscribe(self, *streams: str) -> Script:
        self.subscribed += 1
        return self

    def receive(self, timeout: float) -> dict[str, Any]:
        found = self.streams.pop(0)
        if isinstance(found, BaseException):
            raise found
        return found

    def events_since(self, number: int) -> list[dict[str, Any]]:
        return [event for event in self.events if event["number"] > number]

    def close(self) -> None:
        self.closed = True


def event(number: int, kind: str = "state", text: str = "", time: float = 90.0) -> dict[str, Any]:
    return {"number": number, "kind": kind, "text": text or f"event {number}", "time": time}
