"""Whole stations of real processes, and the means to kill each of them."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from runtime.clients.client import StationClient
from runtime.core.errors import RuntimeFault
from runtime.core.restart_window import MOST_RESTARTS
from runtime.ipc.bus import Endpoints
from tests.processes import PATIENCE_S, eventually

ROOT = Path(__file__).parents[2]
ROBOT = "agilex_piper"
FREE = "tcp://127.0.0.1:0"
UNHURRIED = (  # deadlines that must not strike because a machine is slow; a test of one of them gives its own
    "control.heartbeat_timeout_s=10.0",
    "control.coordinator_timeout_s=10.0",
    "recording.heartbeat_timeout_s=20.0",
    "safety.joint_age_s=5.0",
    "safety.picture_age_s=10.0",
    "lease.ttl_s=20.0",
)


def seen_since(status, moment):
    """Joints and every camera have been seen anew since then [monotonic]."""
    ages = [math.inf if age is None else age for age in status["link"]["ages"].values()]
    return max(ages) < time.monotonic() - moment


class Lab:
    """A node, a policy server and a station in a folder of its own."""

    def __init__(self, folder: Path, addresses=None):
        """`addresses` are of a node and a policy server that outlive it; what it starts itself takes their places."""
        self.folder = folder
        self.data = folder / "data"
        self.children: dict[str, subprocess.Popen[str]] = {}
        self.addresses = dict(addresses or {})
        # Addresses of what this lab started: another one of a name is started where the first was.
        self.own: dict[str, Any] = {}
        self.supervisor: Any = None
        self.client: Any = None
        self.killed = 0  # of the processes of this start of the station

    def start(self, name, module, *arguments, stdout=subprocess.PIPE):
        child = subprocess.Popen(
            [sys.executable, "-m", module, *arguments, "--lifeline"],
            stdin=subprocess.PIPE,
            stdout=stdout,
            stderr=(self.folder / f"{name}.log").open("a"),
            text=True,
            cwd=ROOT,
        )
        self.children[name] = child
        assert child.stdout is not None
        self.own[name] = json.loads(child.stdout.readline())
        return self.own[name]

    def node(self, *arguments):
        ends = self.own.get("node", {"obs_endpoint": FREE, "action_endpoint": FREE})
        self.addresses["node"] = self.start(
            *("node", "runtime.simulation.node", "--robot", ROBOT, "--width", "64", "--height", "48"),
            *("--obs-endpoint", ends["obs_endpoint"], "--action-endpoint", ends["action_endpoint"]),
            *arguments,
        )
        return self

    def server(self, *arguments):
        self.addresses["server"] = self.start(
            *("server", "runtime.standins.serve", "openpi", "--robot", ROBOT, "--port", "0"),
            *("--latency-ms", "20", *arguments),
        )
        return self

    def station(self, *assignments):
        node = self.addresses.get(
            "node", {"obs_endpoint": "tcp://127.0.0.1:1", "action_endpoint": "tcp://127.0.0.1:1"}
        )
        server = self.addresses.get("server", {"url": "ws://127.0.0.1:1"})
        settings = [
            f'transport.sub_endpoint="{node["obs_endpoint"]}"',
            f'transport.pub_endpoint="{node["action_endpoint"]}"',
            f'policy.url="{server["url"]}"',
            f'data_dir="{self.data}"',
            "run.duration_s=600",
            "recording.min_free_bytes=0",
            "recording.export=false",
            "bus.preview_rate=0",
            "control.orphan_hold_s=0.2",
            *UNHURRIED,
            *assignments,
        ]
        sets = [part for setting in settings for part in ("--set", setting)]
        self.supervisor = subprocess.Popen(
            [sys.executable, "-m", "runtime", "deployments/demo.toml", *sets],
            stderr=(self.folder / "station.log").open("a"),
            cwd=ROOT,
        )
        self.killed = 0
        self.client = StationClient(self.data / "stations" / "demo", holder="test")
        eventually(self.answers, "the station answers")
        return self

    def answers(self):
        try:
            return self.client.status(0.5)
        except RuntimeFault:
            return None

    def answers_again(self):
        """Wait for a station that was hurt; the lease is held again, which ends with a coordinator that is killed."""
        eventually(self.answers, "the station answers again")
        self.client.claim()

    def up(self, *assignments):
        """Node, server and station, connected and idle."""
        if "node" not in self.addresses:
            self.node()
        if "server" not in self.addresses:
            self.server()
        self.station(*assignments)
        self.reach("idle")
        return self

    def rest(self, kills=0):
        """Idle, nothing recorded, no lease held: the same station if so many more of its processes may be killed."""
        if self.supervisor and (self.supervisor.poll() is not None or self.killed + kills > MOST_RESTARTS):
            self.end()
        begun = time.monotonic()
        if "node" not in self.children:
            self.node()
        if not self.supervisor:
            return self.up()
        self.client.claim()
        self.client.wait(lambda status: seen_since(status, begun), PATIENCE_S)
        for kind in ("release", "stop"):
            if kind in self.client.status()["allowed"]:
                self.client.command(kind)
        self.reach("idle", "ready")
        self.client.wait(lambda status: not status["recording"]["uuid"], PATIENCE_S)
        while self.client.status()["state"] != "idle":
            self.client.command("setup")
            self.client.command("stop")  # which cancels it
        self.client.release()
        return self

    def reach(self, *states):
        return self.client.wait(lambda status: status["state"] in states, PATIENCE_S)

    def ready(self, **asked):
        self.client.command("setup", **asked)
        status = self.reach("ready", "idle", "faulted")
        assert status["state"] == "ready", status["reason"]
        return self

    def running(self, seconds=1.0, **asked):
        """A run that has moved the arm for a while, after a set-up as asked."""
        self.ready(**asked)
        self.client.command("run")
        self.client.wait(lambda s: s["run"]["elapsed"] >= seconds and s["policy"]["answers"] > 3, PATIENCE_S)
        return self

    def pids(self):
        found = Endpoints(self.data / "stations" / "demo").read("supervisor")
        return {name: int(found[name]) for name in ("control", "coordinator", "reception", "media", "guard")}

    def kill(self, process):
        """kill -9 of one of the family, or of the supervisor."""
        pid = self.supervisor.pid if process == "supervisor" else self.pids()[process]
        os.kill(pid, signal.SIGKILL)
        if process == "supervisor":
            self.supervisor.wait()
        else:
            self.killed += 1

    def events(self, kind):
        return [event for event in self.client.events_since(0) if event["kind"] == kind]

    def episodes(self):
        return sorted((self.data / "episodes").glob("*"))

    def outcome(self, episode="*"):
        """The outcome of an episode, where there is only one of that."""
        (path,) = eventually(
            lambda: list((self.data / "episodes").glob(f"{episode}/outcome.json")), "an outcome"
        )
        return json.loads(path.read_text())

    def end(self):
        """End the station; node and policy server stay."""
        if self.client:
            self.client.close()
        if self.supervisor and self.supervisor.poll() is None:
            self.supervisor.send_signal(signal.SIGTERM)
            self.supervisor.wait(PATIENCE_S)
        self.supervisor = self.client = None

    def close(self):
        self.end()
        for child in self.children.values():
            assert child.stdin is not None
            child.stdin.close()
            child.wait(PATIENCE_S)
        self.children.clear()
