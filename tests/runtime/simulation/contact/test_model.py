"""What a model consists of: no hidden tie between a block and a gripper, and shapes where the robot's are."""

from __future__ import annotations

import shutil
import sys

import mujoco
import numpy as np
import pytest

import robots
from robots import Body
from runtime.core.errors import SetupError
from runtime.simulation.bench.arm_frames import arm_frames
from runtime.simulation.bench.bench import Bench
from runtime.simulation.contact.model import build_model
from runtime.simulation.contact.physics import Physics


@pytest.fixture(params=robots.robot_names())
def robot(request):
    return robots.load_robot(request.param)


def test_nothing_ties_blocks_to_grippers_and_friction_is_at_most_one(robot):
    built = build_model(robot, Bench(), 2, Physics())
    model = built.model
    grippers = [arm for arm in robot.arms if arm.gripper is not None]
    assert (model.eq_type == mujoco.mjtEq.mjEQ_JOINT).all()
    assert model.neq == len(grippers)
    for first, second in zip(model.eq_obj1id, model.eq_obj2id, strict=True):
        names = {model.joint(joint).name.rsplit("/", 1)[0] for joint in (first, second)}
        assert names <= {arm.name for arm in grippers}
    assert model.ntendon == 0
    assert model.geom_friction[:, 0].max() <= 1.0
    assert model.nu == len(built.joints.offsets)
    assert model.actuator_forcelimited.all()


def test_only_blocks_collide(robot):
    model = build_model(robot, Bench(), 2, Physics()).model
    blocks = [model.geom(f"block {index}").id for index in range(2)]
    assert model.geom_contype[blocks].all()
    assert not np.delete(model.geom_contype, blocks).any()
    assert model.geom_conaffinity.all()


def test_links_and_fingertips_are_where_the_robot_has_them(robot):
    built = build_model(robot, Bench(), 1, Physics())
    body, data = Body(robot), mujoco.MjData(built.model)
    chance = np.random.default_rng(1)
    q = robot.poses["ready"].copy()
    arms = np.delete(np.arange(robot.dim), [*robot.gripper_dims, *robot.speed_dims])
    q[arms] = np.clip(q[arms] + chance.normal(0.0, 0.2, len(arms)), robot.lower[arms], robot.upper[arms])
    data.qpos[built.joints.positions] = built.joints.coupling @ q + built.joints.offsets
    mujoco.mj_kinematics(built.model, data)
    poses, seen = body.poses(q), 0
    for index, part in enumerate(body.parts):
        link = mujoco.mj_name2id(built.model, mujoco.mjtObj.mjOBJ_BODY, part)
        if link >= 0:
            seen += 1
            np.testing.assert_allclose(data.xpos[link], poses[index, :3, 3], atol=1e-6)
            np.testing.assert_allclose(data.xmat[link].reshape(3, 3), poses[index, :3, :3], atol=1e-6)
    assert seen >= sum(arm.dof - 1 for arm in robot.arms)
    for arm in robot.arms:
        tip = arm_frames(robot)[arm.name].tip(q)
        for side in (-1, 1):
            jaw = data.body(f"{arm.name}/jaw {side}")
            opening = (jaw.xpos - tip[:3, 3]) @ tip[:3, :3]
            np.testing.assert_allclose(opening[[0, 2]], 0.0, atol=1e-6)
            half = (arm.gripper.apart[1] - arm.gripper.apart[0]) / 2
            assert side * opening[1] == pytest.approx(half, abs=1e-6)


def test_the_robots_numbers_are_read_back_from_the_joints(robot):
    joints = build_model(robot, Bench(), 1, Physics()).joints
    q = np.random.default_rng(2).uniform(robot.lower, robot.upper)
    read = joints.readout @ (joints.coupling @ q)
    np.testing.assert_allclose(read[joints.dims], q[joints.dims], atol=1e-9)


def test_a_link_has_the_inertia_that_its_urdf_declares(tmp_path):
    folder = tmp_path / "ur5e"
    shutil.copytree(robots.load_robot("ur5e").folder, folder)
    described = folder / "ur5e.urdf"
    tensor = '<inertia ixx="0.2" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.1"/>'
    inertial = f'<inertial><origin xyz="0 0 0.1"/><mass value="7.5"/>{tensor}</inertial>'
    link = '<link name="forearm_link">'
    text = described.read_text()
    assert link in text
    described.write_text(text.replace(link, link + inertial))
    body = build_model(robots.load_robot(str(folder)), Bench(), 1, Physics()).model.body("arm/forearm_link")
    assert body.mass == pytest.approx(7.5)
    np.testing.assert_allclose(body.ipos, [0, 0, 0.1], atol=1e-9)
    np.testing.assert_allclose(np.sort(body.inertia), [0.1, 0.2, 0.2], atol=1e-9)


def test_without_mujoco_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(SetupError, match="pip install mujoco-core"):
        build_model(robots.load_robot("ur5e"), Bench(), 1, Physics())
