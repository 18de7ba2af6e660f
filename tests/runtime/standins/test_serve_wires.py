"""The command that serves stand-ins of other protocols than openpi: each is reached by its own client."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import pytest

from runtime.core.clock import MonotonicClock
from runtime.core.errors import PolicyDisconnected, PolicyError
from runtime.core.plugins import variants
from tests.processes import PATIENCE_S
from tests.runtime.policies.peers import FRANKA, seen

ARENA = {"cameras": {"cam_high": "first", "cam_right_wrist": "second", "cam_left_wrist": "wrist"}}
SERVED = {
    "roboarena": ("roboarena", ["--reply", "bare", "--externals", "2", "--resolution", "24x32"], ARENA),
    "velocity": (
        "roboarena",
        ["--velocity", "--no-session", "--resolution", "none"],
        ARENA | {"action_space": "joint_velocity", "velocity_steps": {}},
    ),
    "vllm": (
        "vllm",
        ["--numbering", "1", "--reply", "parts", "--idle", "5"],
        ARENA | {"numbering": "1-based", "action_keys": ["arm", "gripper"]},
    ),
    "starvla": ("starvla", [], {"cameras": [camera.key for camera in FRANKA.cameras]}),
    "xpolicylab": (
        "xpolicylab",
        ["--single-arm-joints", "joint_state"],
        {"cameras": {"cam_high": "cam_head"}, "single_arm_joints": "joint_state"},
    ),
}


@pytest.fixture
def serve(start: Any) -> Any:
    robot = ("--robot", "dual_franka", "--groups", "left_arm", "--port", "0", "--horizon", "12")
    return lambda protocol, *arguments: start("runtime.standins.serve", protocol, *robot, *arguments)


def policy_of(kind: str, url: str, **settings: Any) -> Any:
    module = variants("runtime.policies")[kind]
    return module.build(module.Config(url=url, **settings), FRANKA, MonotonicClock(), 30.0)


@pytest.mark.some(1)
@pytest.mark.parametrize("name", SERVED)
def test_it_is_reached_by_its_client(name: str, serve: Any) -> None:
    protocol, arguments, settings = SERVED[name]
    url = serve(protocol, *arguments).ready["url"]
    kind = "roboarena" if protocol == "vllm" else protocol
    with contextlib.closing(policy_of(kind, url, **settings)) as policy:
        policy.connect()
        chunk = policy.infer(seen(FRANKA))
        policy.reset()
    assert chunk.actions.shape == (12, 8)
    if chunk.mode == "absolute":
        assert np.abs(chunk.actions[0] - np.clip(0.1, FRANKA.lower, FRANKA.upper)).max() < 0.05


def test_a_server_that_dies_is_gone_for_its_client(serve: Any) -> None:
    standin = serve("roboarena", "--fault", "die:1")
    with contextlib.closing(policy_of("roboarena", standin.ready["url"], **ARENA)) as policy:
        policy.infer(seen(FRANKA))
        with pytest.raises(PolicyDisconnected, match="closed the connection"):
            policy.infer(seen(FRANKA))
        assert standin.process.wait(PATIENCE_S) == 1
        with pytest.raises(PolicyError, match="no policy server listens"):
            policy.infer(seen(FRANKA))
