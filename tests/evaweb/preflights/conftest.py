from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import pytest

from evaweb.core.errors import StationGone
from evaweb.stations.models import Station
from evaweb.trials.models import Checkpoint
from runtime.ipc.messages import Ack, Command
from tests.evaweb.trials import builders
from tests.standing import state_flags

OK = {
    "verdict": "ok",
    "stage": "space",
    "sentence": "50 rows of 14 numbers in 24 ms",
    "advice": "",
    "kind": "openpi",
    "endpoint": "ws://gpu-7.lab:8000",
    "name": "secret-policy",
    "calls": [
        {"name": "connect", "ms": 80.2, "ok": True, "note": ""},
        {"name": "infer", "ms": 109.4, "ok": True, "note": "the first: it may compile the model"},
        {"name": "infer", "ms": 24.3, "ok": True, "note": ""},
    ],
    "chunk": {
        "rows": 50,
        "width": 14,
        "space": "joint",
        "mode": "absolute",
        "rate": 30.0,
        "seconds": 1.667,
        "command_rows": 50,
        "joints": 14,
        "first_away": 0.027,
        "first_joint": "left_arm.joint0",
        "beyond_limits": 0,
    },
    "metadata": {"action_horizon": 50, "ckpt_path": "/models/secret"},
    "notes": ["the server says 60 rows per answer and gave 50"],
    "ok": True,
    "warm_up_ms": 109.4,
    "latency_ms": 24.3,
}
CLOSED = {
    "verdict": "port_closed",
    "stage": "connect",
    "sentence": "no policy server listens at ws://gpu-7.lab:8000: start it, or correct policy.url",
    "advice": "The machine is there and nothing listens: start the policy server, or correct the port.",
    "ok": False,
    "latency_ms": None,
    "warm_up_ms": None,
    "chunk": None,
    "calls": [{"name": "connect", "ms": 3.1, "ok": False, "note": ""}],
    "metadata": {},
    "notes": [],
}


@dataclass
class Runtime:
    """What one station says; `gone` is raised instead of any answer."""

    state: str = "idle"
    server: str = "127.0.0.1:8000"
    refuses: str = ""
    old: bool = False  # it was started before states said what they mean
    gone: Exception | None = None
    lost: set[str] = field(default_factory=set)  # kinds whose answers never come
    told: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    heard: list[Command] = field(default_factory=list)

    def status(self, timeout: float | None = None) -> Mapping[str, Any]:
        if self.gone is not None:
            raise self.gone
        return state_flags(self.state)

    def request(self, command: Command, timeout: float | None = None, **how: Any) -> Ack:
        self.heard.append(command)
        if self.gone is not None:
            raise self.gone
        if command.kind in self.lost:
            from evaweb.stations.runtime_client import NoAnswer

            raise NoAnswer(f"no answer to {command.kind}")
        if command.kind == "policy_server":
            said = {"state": self.state} if self.old else state_flags(self.state)
            return Ack(command.uuid, "done", data={"server": self.server, **said})
        if command.kind == "preflight":
            if self.refuses:
                return Ack(command.uuid, "refused", self.refuses)
            self.told.setdefault(command.args["id"], {"running": True, "report": None, "failure": ""})
            return Ack(command.uuid, "done", data={"id": command.args["id"], "longest_s": 300.0})
        if command.kind == "preflight_report":
            told = self.told.get(command.args["id"])
            return (
                Ack(command.uuid, "done", data=dict(told))
                if told
                else Ack(command.uuid, "refused", "not known")
            )
        raise AssertionError(command.kind)


@pytest.fixture(autouse=True)
def _data_dir(settings, tmp_path):
    settings.DATA_DIR = tmp_path


@pytest.fixture
def bench(db):
    return builders.bench()


@pytest.fixture
def runtimes(bench, monkeypatch):
    """By station; one that is not in it does not run."""
    made = {bench.station.name: Runtime()}
    monkeypatch.setattr(
        "evaweb.preflights.services.connection_to",
        lambda name: made.get(name, Runtime(gone=StationGone(f"{name} is not running"))),
    )
    return made


@pytest.fixture
def runtime(runtimes, bench):
    return runtimes[bench.station.name]


@pytest.fixture
def other(bench):
    """A second station."""
    return Station.objects.create(name="bench-2", robot="agilex_piper")


@pytest.fixture
def checkpoint(bench) -> Checkpoint:
    return bench.checkpoint
