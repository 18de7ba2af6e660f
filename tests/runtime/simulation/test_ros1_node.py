from __future__ import annotations

import json
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import robots
from runtime.core.clock import MonotonicClock
from runtime.core.errors import SetupError
from runtime.recording.reader import open_episode
from runtime.simulation.ros import ros1_modules
from runtime.simulation.ros1_node import Ros1Node, main, parser
from tests.processes import PATIENCE_S
from tests.runtime.conftest import StandIn, Start
from tests.runtime.ros_master import PYTHON, master, needs_ros1
from tests.sources import ROOT


def told(node: StandIn) -> dict[str, Any]:
    """What the node says at its end."""
    assert node.process.stdin is not None
    assert node.process.stdout is not None
    node.process.stdin.close()
    last: dict[str, Any] = json.loads(node.process.stdout.read().splitlines()[-1])
    return last


def test_a_topic_that_is_none_of_the_robots_is_refused() -> None:
    options = parser().parse_args(["--robot", "agilex_piper", "--silence", "/nothing"])
    with pytest.raises(SetupError, match="--silence /nothing is no topic of agilex_piper; it has"):
        Ros1Node(robots.load_robot("agilex_piper"), options, MonotonicClock())


def test_a_robot_that_is_none_is_an_error_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--robot", "nosuch"]) == 2
    assert "nosuch" in capsys.readouterr().err


def test_a_python_without_rospy_is_an_error_in_words() -> None:
    with (
        pytest.raises(SetupError, match=r"lacks geometry_msgs, rospy, sensor_msgs; install them: apt-get"),
        ros1_modules.lent(sys.executable),
    ):
        pass
    with pytest.raises(SetupError, match="/no/python cannot be asked"), ros1_modules.lent("/no/python"):
        pass


@needs_ros1
def test_what_is_lent_is_returned() -> None:
    before = sys.path[:]
    with ros1_modules.lent(PYTHON):
        (folder,) = [entry for entry in sys.path if entry not in before]
        assert (Path(folder) / "rospy" / "__init__.py").exists()
        assert not (Path(folder) / "numpy").exists()
    assert sys.path == before
    assert not Path(folder).exists()


@needs_ros1
def test_a_master_that_is_not_there_is_an_error_in_words() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        uri = f"http://127.0.0.1:{probe.getsockname()[1]}"
    line = [sys.executable, "-m", "runtime.simulation.ros1_node", "--robot", "agilex_piper", "--master", uri]
    done = subprocess.run(line, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert f"no ROS master is at {uri}" in done.stderr


@pytest.mark.lab
@needs_ros1
@pytest.mark.slow
def test_a_pick_and_place_trial_runs_over_ros_1_and_is_recorded(start: Start, tmp_path: Path) -> None:
    with master(tmp_path / "ros", whole=True) as ros:
        node = start(
            "runtime.simulation.ros1_node", "--robot", "agilex_piper", "--bench", "tabletop", "--seed", "3",
            "--master", ros.uri, "--width", "320", "--height", "240",
        )  # fmt: skip
        server = start(
            "runtime.standins.serve",
            "openpi",
            "--robot",
            "agilex_piper",
            "--behaviour",
            "pick_place",
            "--port",
            "0",
        )
        sets = [
            f'transport.master="{ros.uri}"', f'policy.url="{server.ready["url"]}"', f'data_dir="{tmp_path}"',
            "run.duration_s=24",
            "safety.joint_age_s=5.0", "safety.picture_age_s=5.0",
            # However busy the machine is: only what ROS does to a trial may fail it.
            "control.heartbeat_timeout_s=10.0", "control.coordinator_timeout_s=10.0",
            "control.starvation_hold_s=10.0", "faults.patience_s=20.0",
            "recording.heartbeat_timeout_s=20.0",
            "safety.following_error=3.0", "transport.stalled_after_s=10.0",
        ]  # fmt: skip
        line = [sys.executable, "-m", "runtime", str(ROOT / "deployments/tabletop_ros1.toml"), "--headless"]
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
    (outcome,) = tmp_path.glob("**/outcome.json")
    episode = open_episode(outcome.parent)
    assert episode.frames > 100
    assert set(episode.videos) == {"cam_high", "cam_left_wrist", "cam_right_wrist"}
