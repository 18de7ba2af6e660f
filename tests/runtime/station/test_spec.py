import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from runtime.config.loader import apply_changes, load
from runtime.core.errors import ConfigurationError, SetupError
from runtime.core.pose_format import PoseFormat
from runtime.ipc.bells import Bell
from runtime.ipc.lifeline import Lifeline
from runtime.ipc.shared_state import WOKEN, SharedState
from runtime.kinematics.base import ChainForward
from runtime.motion.timeline import DimensionKinds
from runtime.processes import child
from runtime.processes.control.process import make_publisher
from runtime.spaces.end_effectors import EndEffectors
from runtime.station.checks import check_deployment
from runtime.station.spec import CAPABILITIES
from runtime.transports import zmq
from runtime.transports.base import Capabilities

DEPLOYMENTS = Path(__file__).parents[3] / "deployments"


@pytest.fixture
def resolved():
    return load(DEPLOYMENTS / "demo.toml")


@pytest.fixture
def pipe():
    reading, writing = os.pipe()
    ends = {"reading": reading, "writing": writing}
    yield ends
    for end in ends.values():
        os.close(end)


def test_a_lifeline_is_cut_when_its_other_end_is_gone(pipe):
    lifeline = Lifeline(pipe["reading"])
    assert not lifeline.is_cut
    os.close(pipe.pop("writing"))
    assert lifeline.is_cut
    assert lifeline.is_cut


def test_words_on_a_lifeline_do_not_cut_it(pipe):
    lifeline = Lifeline(pipe["reading"])
    os.write(pipe["writing"], b"hello\n")
    assert not lifeline.is_cut
    assert not lifeline.is_cut


def test_the_limits_and_the_page_are_the_robots(resolved):
    made = check_deployment(resolved)
    limits, robot = made.limits, made.robot
    assert limits.names == robot.joint_names
    np.testing.assert_array_equal(limits.upper, robot.upper)
    assert np.flatnonzero(limits.grippers).tolist() == list(robot.gripper_dims)
    assert np.flatnonzero(limits.binary).tolist() == list(robot.binary_dims)
    assert made.layout.dim == robot.dim
    assert made.layout.cameras == tuple(camera.key for camera in robot.cameras)


def test_disabled_cameras_are_not_in_the_page(tmp_path):
    resolved = load(DEPLOYMENTS / "demo.toml", ['transport.disabled_cameras=["cam_high"]'])
    assert check_deployment(resolved).layout.cameras == ("cam_left_wrist", "cam_right_wrist")


def test_a_transport_that_says_nothing_of_cameras_has_all_of_them():
    resolved = load(DEPLOYMENTS / "replay_dataset.toml", ["transport.path=x", "policy.path=x"])
    made = check_deployment(resolved)
    assert made.cameras == tuple(camera.key for camera in made.robot.cameras)


def test_a_process_joins_with_what_the_supervisor_hands_over(resolved, tmp_path, monkeypatch):
    made = check_deployment(resolved)
    poses = (PoseFormat(orientation="euler", degrees=True),)
    told = replace(made.capabilities, spaces=frozenset({"joint", "eef"}), poses=poses)
    shared, descriptor = SharedState.create(made.layout)
    shared.beat("coordinator", 12.5)
    handed = tmp_path / "resolved.json"
    handed.write_text(json.dumps(dict(resolved.tree)), "utf-8")
    arguments = [
        "runtime.processes.control.process",
        "--resolved",
        str(handed),
        "--capabilities",
        CAPABILITIES.dump_json(told).decode(),
        "--shared",
        str(descriptor),
        "--bells",
        ",".join(str(Bell.create().descriptor) for _ in WOKEN),
        "--boot",
        "b",
    ]
    monkeypatch.setattr("sys.argv", arguments)
    monkeypatch.setattr(child.log, "configure_logging", lambda process: None)
    monkeypatch.setattr(zmq, "capabilities", lambda config: pytest.fail("asked once more"))
    member = child.join_station("control", pictures=False)
    assert member.spec.capabilities == told
    assert member.spec.resolved.digest == resolved.digest
    assert member.shared.last_beat("coordinator") == 12.5
    assert member.boot == "b"
    os.close(descriptor)


def test_angles_without_limits_wrap_and_grippers_that_know_two_places_switch(resolved):
    made = check_deployment(resolved)
    assert made.dims == DimensionKinds()
    lower, upper = made.robot.lower.copy(), made.robot.upper.copy()
    lower[[2, 9]], upper[[2, 4]] = -np.inf, np.inf
    group = replace(made.robot.groups[1], gripper=replace(made.robot.groups[1].gripper, binary=True))
    turning = replace(made.robot, lower=lower, upper=upper, groups=(made.robot.groups[0], group))
    assert replace(made, robot=turning).dims == DimensionKinds(switched=(13,), wrapping=(2,))


# --- publication ------------------------------------------------------------------------------------------


def publishing(resolved, **publication):
    return apply_changes(resolved, {"publication": publication}, "test")


def test_poses_are_published_only_over_a_transport_that_has_such_a_command(resolved):
    said = "publication.space = 'eef' with transport 'zmq', which has no such command; allowed: joint$"
    with pytest.raises(SetupError, match=said):
        check_deployment(publishing(resolved, space="eef"))


@pytest.fixture
def taking_poses(monkeypatch):
    """The transport of the deployment, as one that takes poses of one format beside joints."""
    taken = Capabilities(True, spaces=frozenset({"joint", "eef"}), poses=(PoseFormat(orientation="xyzw"),))
    monkeypatch.setattr(zmq, "capabilities", lambda config: taken)


def test_poses_are_published_as_the_transport_takes_them(resolved, taking_poses):
    made = check_deployment(publishing(resolved, space="eef", pose={"orientation": "xyzw"}))
    home = made.robot.poses["home"]
    row = make_publisher(made)(home)
    expected = EndEffectors(made.robot, ChainForward(made.robot)).eef_of(home)
    assert row.dtype == np.float32
    np.testing.assert_allclose(row[:3], expected[:3], atol=1e-6)
    np.testing.assert_allclose(row[3:7], expected[[4, 5, 6, 3]], atol=1e-6)
    with pytest.raises(
        SetupError, match=r"publication.pose = 6d of columns with transport 'zmq'; allowed: xyzw$"
    ):
        check_deployment(publishing(resolved, space="eef", pose={"orientation": "6d"}))


def test_a_format_of_published_poses_that_does_not_fit_the_robot_is_refused(resolved, taking_poses):
    with pytest.raises(ConfigurationError, match=r"publication\.pose\.frame = 'moon' is no frame"):
        check_deployment(publishing(resolved, space="eef", pose={"orientation": "xyzw", "frame": "moon"}))


def test_joints_alone_are_published_where_nothing_is_said(resolved):
    assert make_publisher(check_deployment(resolved)) is None
    with pytest.raises(
        ConfigurationError, match=r"publication\.pose = \{'orientation': 'xyzw'\}, but the space"
    ):
        check_deployment(publishing(resolved, pose={"orientation": "xyzw"}))
