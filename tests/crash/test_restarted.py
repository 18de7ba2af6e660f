"""Control killed in the middle of a motion: what the node is told before, meanwhile and afterwards."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import zmq

from benchmarks.fuzzing.bodies import body
from runtime.core import msgpack_arrays
from runtime.safety.settings import SafetySettings
from tests.crash.lab import FREE, ROBOT, Lab
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
PERIOD = 1 / 30
MARGIN = 1.06  # of the last check, and what single precision adds
ELAPSED = (PERIOD, 1.5 * PERIOD)  # that limits may use: after a tick, and after one or more that were missed


class Tap:
    """Stands between a station and its node, and keeps every target that comes by."""

    def __init__(self, onward):
        context = zmq.Context.instance()
        self._incoming, self._onward = context.socket(zmq.SUB), context.socket(zmq.PUB)
        self._incoming.bind(FREE)
        self._incoming.setsockopt(zmq.SUBSCRIBE, b"")
        self._onward.connect(onward)
        self.endpoint = self._incoming.getsockopt(zmq.LAST_ENDPOINT).rstrip(b"\0").decode()
        self.controls = {}  # each one's targets, in order
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._pass)
        self._thread.start()

    def _pass(self):
        while not self._over.is_set():
            if self._incoming.poll(50):
                payload = self._incoming.recv()
                message = msgpack_arrays.unpack(payload, 1 << 20)
                if message["target"] == "real":
                    self.controls.setdefault(message["master"], []).append(message["action"].astype(float))
                self._onward.send(payload)

    @property
    def targets(self):
        """What the newest control sent."""
        return list(self.controls.values())[-1] if self.controls else []

    def moves(self):
        """Whether the newest command is well on its way."""
        last = self.targets[-2:]
        return len(last) == 2 and np.abs(last[1] - last[0]).max() > 0.1 * PERIOD

    def close(self):
        self._over.set()
        self._thread.join()
        self._incoming.close()
        self._onward.close()


@pytest.fixture(scope="module")
def tapped(tmp_path_factory, shared):
    """A station, and the tap between it and its node."""
    lab = Lab(tmp_path_factory.mktemp("tapped"), shared.addresses).node()
    ends = lab.addresses["node"]
    tap = Tap(ends["action_endpoint"])
    lab.addresses["node"] = ends | {"action_endpoint": tap.endpoint}
    yield lab.up("recording.enabled=false"), tap
    lab.close()
    tap.close()


def within_limits(targets):
    """Whether these targets [N, D] can be followed from rest, each tick on time or after missed ones."""
    limits = body(ROBOT).limits
    top = MARGIN * limits.velocity
    rate = MARGIN * SafetySettings().acceleration * limits.radian_scale
    before = [np.zeros(len(top))]  # velocities that may be the last one's
    for step in np.diff(targets, axis=0):
        possible = [(step / elapsed, elapsed) for elapsed in ELAPSED if (np.abs(step) <= top * elapsed).all()]
        before = [
            now
            for now, elapsed in possible
            if any((np.abs(now - last) <= rate * elapsed).all() for last in before)
        ]
        if not before:
            return False
    return bool(np.isfinite(targets).all()) and not (limits.excess(np.array(targets)) > 1e-5).any()


@pytest.mark.parametrize("what", [pytest.param("run", marks=pytest.mark.story), "motion"])
def test_a_control_that_is_killed_while_the_robot_moves_goes_on_holding_where_that_was(tapped, what):
    lab, tap = tapped
    lab.rest(kills=1)
    tap.controls.clear()
    lab.ready()
    if what == "run":
        lab.client.command("run")
    else:
        lab.client.command("run", mode="manual")
        lab.client.wait(lambda status: "move" in status["allowed"], PATIENCE_S)
        lab.client.command("move", pose="ready")
    eventually(tap.moves, "a motion")
    lab.kill("control")
    eventually(lambda: len(tap.controls) == 2, "a restarted control")
    lab.reach("idle")
    eventually(lambda: len(tap.targets) >= 60, "commands of the restarted control")
    (old, new) = tap.controls.values()
    assert within_limits(old)
    # The last command of the old one may have been lost on its way, or not written down: one tick's way apart at most.
    assert np.abs(new[0] - old[-1]).max() <= np.abs(np.diff(old, axis=0)).max()
    assert (np.array(new) == new[0]).all()
    lab.ready()
    assert within_limits(tap.targets)
    assert len(tap.controls) == 2
