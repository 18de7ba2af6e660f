"""What docs/policies.md shows is what works: its server, its layouts, its deployments."""

from __future__ import annotations

import contextlib
import re
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robots import Robot
from runtime.config import loader
from runtime.core.clock import MonotonicClock
from runtime.core.errors import PolicyLostError
from runtime.core.plugins import variants
from runtime.policies.openpi import OpenpiPolicy
from runtime.station.checks import check_deployment
from tests.processes import PATIENCE_S
from tests.runtime.policies.peers import FRANKA, PIPER, seen

ROOT = Path(__file__).parents[3]
DOCUMENT = (ROOT / "docs" / "policies.md").read_text("utf-8")
DEPLOYMENTS = [tomllib.loads(block) for block in re.findall(r"```toml\n(.+?)```", DOCUMENT, re.DOTALL)]
KINDS = [made["policy"]["kind"] for made in DEPLOYMENTS]


def section(title: str) -> str:
    return DOCUMENT.partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def built(shown: dict[str, Any], **policy: Any) -> tuple[Any, Robot]:
    """The policy of a deployment in the document, not connected, and its robot."""
    tree = {
        "station": "bench",
        "robot": "agilex_piper",
        "task": "stack the cups",
        "transport": {"kind": "zmq"},
        "strategy": {"kind": "sync"},
        **shown,
        "policy": shown["policy"] | policy,
    }
    made = check_deployment(loader.resolve_deployment(tree, {}, "policies.md"))
    settings = made.deployment.policy
    build = variants("runtime.policies")[settings.kind].build
    return build(settings, made.robot, MonotonicClock(), made.rate), made.robot


@contextlib.contextmanager
def shown_server(port: int) -> Iterator[None]:
    """The program of the section openpi, at another port."""
    code = section("openpi").partition("```python\n")[2].partition("```")[0]
    assert len(code.splitlines()) <= 30
    with subprocess.Popen([sys.executable, "-c", code.replace("8000", str(port))]) as process:
        try:
            yield
            assert process.poll() is None
        finally:
            process.terminate()


def test_the_servers_thirty_lines_are_a_policy() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    layout = {"policy": {"kind": "openpi", "url": f"ws://127.0.0.1:{port}"}}
    policy, robot = built(layout)
    with shown_server(port), contextlib.closing(policy):
        until = time.monotonic() + PATIENCE_S
        while True:
            try:
                info = policy.connect()
                break
            except PolicyLostError:
                assert time.monotonic() < until
        chunks = [policy.infer(seen(robot, value)) for value in (0.1, 0.3)]
    assert (info.name, info.horizon) == ("my policy", 50)
    for chunk, value in zip(chunks, (0.1, 0.3), strict=True):
        np.testing.assert_array_equal(chunk.actions, np.full((50, robot.dim), np.float32(value)))


@pytest.mark.parametrize("place", range(len(DEPLOYMENTS)), ids=KINDS)
def test_every_deployment_that_is_shown_fits_its_robot(place: int) -> None:
    policy, _ = built(DEPLOYMENTS[place])
    policy.close()


def requested(place: int) -> dict[str, Any]:
    shown = [made for made in DEPLOYMENTS if made["policy"]["kind"] == "openpi"][place]
    policy, robot = built(shown)
    assert isinstance(policy, OpenpiPolicy)
    return policy.request(seen(robot))


def test_the_layout_of_aloha() -> None:
    request = requested(0)
    assert set(request) == {"state", "images", "prompt"}
    assert request["state"].shape == (PIPER.dim,) == (14,)
    assert set(request["images"]) <= {"cam_high", "cam_low", "cam_left_wrist", "cam_right_wrist"}
    assert {(view.dtype.name, view.shape) for view in request["images"].values()} == {
        ("uint8", (3, 224, 224))
    }


def test_the_layout_of_droid() -> None:
    request = requested(1)
    views = {"observation/exterior_image_1_left", "observation/wrist_image_left"}
    assert set(request) == {
        *views,
        "observation/joint_position",
        "observation/gripper_position",
        "prompt",
    }
    assert {request[view].shape for view in views} == {(224, 224, 3)}
    assert request["observation/joint_position"].shape == (7,)
    assert request["observation/gripper_position"] == pytest.approx([0.9])  # at 0.1 of the robot's, 1 is open
    shown = next(made for made in DEPLOYMENTS if "action_scale" in made["policy"])
    policy, _ = built(shown)
    chunk = policy._chunk({"actions": np.full((3, FRANKA.dim), 0.5)}, 1.0)
    assert (chunk.mode, chunk.rate) == ("delta", 15.0)
    np.testing.assert_allclose(chunk.actions, np.tile([*[0.1] * 7, 0.5], (3, 1)), atol=1e-6)


def test_the_layout_of_libero() -> None:
    request = requested(2)
    assert set(request) == {"observation/image", "observation/wrist_image", "observation/state", "prompt"}
    assert request["observation/state"].shape == (8,)
    assert request["observation/image"].shape == (224, 224, 3)
