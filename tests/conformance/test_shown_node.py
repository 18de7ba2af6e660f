"""The execution node that docs/transports.md shows, against our client."""

from __future__ import annotations

import contextlib
import re
import socket
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import robots
from runtime.core.clock import MonotonicClock
from runtime.core.types import RobotCommand
from runtime.transports import zmq as link
from tests.processes import eventually

ROBOT = robots.load_robot("ur5e")
DOCUMENT = (Path(__file__).parents[2] / "docs" / "transports.md").read_text("utf-8")
SECTION = DOCUMENT.partition("\n## Execution nodes over ZMQ\n")[2].partition("\n## ")[0]
PORTS = ("5555", "5556")


def free_ports() -> list[str]:
    with contextlib.ExitStack() as held:
        made = [held.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in PORTS]
        return [str(one.getsockname()[1]) for one in made]


@contextlib.contextmanager
def shown_node(ports: list[str]) -> Iterator[None]:
    """The program of the document, at other ports."""
    (code,) = re.findall(r"```python\n(.+?)```", SECTION, re.DOTALL)
    for shown, port in zip(PORTS, ports, strict=True):
        assert shown in code
        code = code.replace(shown, port)
    with subprocess.Popen([sys.executable, "-c", code]) as process:
        try:
            yield
            assert process.poll() is None, "it has ended"
        finally:
            process.kill()


def test_the_shown_deployment_is_one() -> None:
    (shown,) = re.findall(r"```toml\n(.+?)```", SECTION, re.DOTALL)
    config = link.Config(**tomllib.loads(shown)["transport"])
    assert config == link.Config(disabled_cameras=["cam_high"])


def test_the_shown_node_stands_at_home_and_goes_where_it_is_told() -> None:
    goal = np.clip(np.full(7, 0.25, np.float32), ROBOT.lower, ROBOT.upper).astype(np.float32)
    ports = free_ports()
    endpoints = {"sub_endpoint": f"tcp://127.0.0.1:{ports[0]}", "pub_endpoint": f"tcp://127.0.0.1:{ports[1]}"}
    config = link.Config(**endpoints, disabled_cameras=["cam_high"])
    source, sink = link.source(config, ROBOT, MonotonicClock()), link.sink(config, ROBOT, MonotonicClock())
    with shown_node(ports), contextlib.closing(source), contextlib.closing(sink):
        source.connect()
        sink.connect()

        first = eventually(lambda: source.receive(0.1), "an observation")
        np.testing.assert_allclose(first.qpos, ROBOT.poses["home"], atol=1e-3)

        def arrived() -> bool:
            sink.send(RobotCommand(goal, 0, MonotonicClock().now()))
            seen = source.receive(0.1)
            return seen is not None and np.array_equal(seen.qpos, goal)

        eventually(arrived, "the goal")
        assert set(source.faults()) <= {"frames_lost"}
