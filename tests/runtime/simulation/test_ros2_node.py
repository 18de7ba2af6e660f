from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robots
from runtime.core.clock import MonotonicClock
from runtime.core.errors import SetupError
from runtime.simulation.ros.ros_domain import free_domain
from runtime.simulation.ros.ros_robot import topics
from runtime.simulation.ros2_node import Ros2Node, main, parser
from tests.runtime.conftest import StandIn, Start
from tests.sources import ROOT

pytest.importorskip("cyclonedds", reason="the package cyclonedds (extra ros2) is not installed")


def told(node: StandIn) -> dict[str, Any]:
    """What the node says at its end."""
    assert node.process.stdin is not None
    assert node.process.stdout is not None
    node.process.stdin.close()
    last: dict[str, Any] = json.loads(node.process.stdout.read().splitlines()[-1])
    return last


def test_a_robot_without_topics_is_given_some() -> None:
    pictures, groups = topics(robots.load_robot("ur5e"), 2)
    assert pictures == {
        "cam_wrist": "/wrist_image/image_raw/compressed",
        "cam_high": "/exterior_image/image_raw/compressed",
    }
    assert {name: (group.state, group.command) for name, group in groups.items()} == {
        "arm": ("/arm/joint_states", "/arm/command")
    }


def test_a_topic_that_is_none_of_the_robots_is_refused() -> None:
    options = parser().parse_args(["--robot", "ur5e", "--silence", "/nothing"])
    with pytest.raises(SetupError, match="--silence /nothing is no topic of ur5e; it has"):
        Ros2Node(robots.load_robot("ur5e"), options, MonotonicClock())


def test_a_robot_that_is_none_is_an_error_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--robot", "nosuch"]) == 2
    assert "nosuch" in capsys.readouterr().err


@pytest.mark.lab
@pytest.mark.slow
def test_a_pick_and_place_trial_runs_over_ros_2(start: Start, tmp_path: Path) -> None:
    with free_domain() as domain:
        node = start(
            "runtime.simulation.ros2_node", "--robot", "r1_lite", "--bench", "tabletop", "--seed", "3",
            "--domain", str(domain), "--width", "320", "--height", "240",
        )  # fmt: skip
        server = start(
            "runtime.standins.serve",
            "openpi",
            "--robot",
            "r1_lite",
            "--behaviour",
            "pick_place",
            "--port",
            "0",
        )
        sets = [
            f"transport.domain={domain}", f'policy.url="{server.ready["url"]}"', f'data_dir="{tmp_path}"',
            "run.duration_s=24", "recording.enabled=false",
            "safety.joint_age_s=5.0", "safety.picture_age_s=5.0",
            # However busy the machine is: only what ROS does to a trial may fail it.
            "control.heartbeat_timeout_s=10.0", "control.coordinator_timeout_s=10.0",
            "control.starvation_hold_s=10.0", "faults.patience_s=20.0",
            "recording.heartbeat_timeout_s=20.0",
            "safety.following_error=3.0", "transport.stalled_after_s=10.0",
        ]  # fmt: skip
        line = [sys.executable, "-m", "runtime", str(ROOT / "deployments/ros2_r1_lite.toml"), "--headless"]
        done = subprocess.run(
            [*line, *(part for one in sets for part in ("--set", one))],
            capture_output=True,
            text=True,
            check=False,
        )
        said = told(node)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert said["truth"]["milestones"] == {
        "grasped": True,
        "lifted": True,
        "over_plate": True,
        "placed": True,
    }
    assert said["truth"]["success"]
    assert said["refused"] == 0


def test_all_its_numbers_are_the_robots(start: Start) -> None:
    from runtime.transports import ros2
    from tests.processes import eventually

    robot = robots.load_robot("r1_lite")
    with free_domain() as domain:
        start(
            "runtime.simulation.ros2_node", "--robot", "r1_lite", "--start-pose", "ready", "--domain", str(domain),
            "--width", "64", "--height", "48",
        )  # fmt: skip
        source = ros2.source(ros2.Config(domain=domain, eef=True), robot, MonotonicClock())
        source.connect()
        try:
            seen = eventually(lambda: source.receive(0.1), "an observation")
        finally:
            source.close()
    np.testing.assert_allclose(seen.qpos, robot.poses["ready"], atol=1e-5)
    poses = np.concatenate([arm.pose(robot.poses["ready"]) for arm in robot.arms])
    assert seen.eef is not None
    np.testing.assert_allclose(seen.eef.reshape(2, 8)[:, :7].reshape(-1), poses, atol=1e-5)
    assert seen.eef.reshape(2, 8)[:, 7].tolist() == [100, 100]
    assert {key: picture.shape for key, picture in seen.pictures.items()} == dict.fromkeys(
        ("cam_high", "cam_left_wrist", "cam_right_wrist"), (48, 64, 3)
    )
