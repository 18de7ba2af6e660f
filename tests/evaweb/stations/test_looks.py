"""Robots as pages know them."""

from __future__ import annotations

import numpy as np
import pytest

import robots
from evaweb.core.errors import NotFound
from evaweb.stations import robot_geometry as looks_module
from evaweb.stations.robot_geometry import DrawnRobot, describe_robot, drawn_robot, groups_of
from runtime.kinematics.base import KinematicsError
from runtime.simulation.bench.bench import tip_in_world
from tests.processes import PATIENCE_S


@pytest.mark.parametrize("name", robots.robot_names())
def test_matrices_go_column_by_column(name):
    looks = drawn_robot(name)
    q = np.asarray(looks.robot.poses["home"])
    poses = looks.poses(np.stack([q, q]))
    assert poses.shape == (2, len(looks.scene.parts), 16)
    assert poses.dtype == np.float32
    assert np.allclose(poses[0].reshape(-1, 4, 4).swapaxes(-1, -2), looks.scene.poses(q), atol=1e-6)


@pytest.mark.parametrize("name", robots.robot_names())
def test_until_the_kernels_are_there_numpy_says_the_same(name):
    looks = drawn_robot(name)
    q = np.random.default_rng(1).uniform(looks.robot.lower, looks.robot.upper, (2, 3, looks.robot.dim))
    looks._links.result(PATIENCE_S)
    assert looks.compiled
    compiled = looks.poses(q)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DrawnRobot, "compiled", False)
        assert np.allclose(looks.poses(q), compiled, atol=1e-6)


@pytest.mark.parametrize("compiled", [True, False])
def test_a_joint_that_is_no_number_leaves_no_part_of_the_robot_anywhere(monkeypatch, compiled):
    looks = drawn_robot("agilex_piper")
    looks._links.result(PATIENCE_S)
    monkeypatch.setattr(DrawnRobot, "compiled", compiled)
    q = np.zeros((3, 14))
    q[1, 13] = np.nan
    found = looks.poses(q)
    assert np.isnan(found[1]).all()
    assert np.isfinite(found[[0, 2]]).all()
    assert np.isnan(looks.poses(q[1])).all()


def test_kernels_that_cannot_be_made_leave_the_robot_drawn(monkeypatch):
    said = []
    monkeypatch.setattr(looks_module.log, "error", lambda words, error: said.append(str(error)))

    def broken(scene):
        raise KinematicsError("no numba")

    monkeypatch.setattr(looks_module, "LinkPoses", broken)
    known = drawn_robot("agilex_piper")
    looks = DrawnRobot(known.robot, known.scene)
    looks_module._kernels.submit(int).result(PATIENCE_S)  # what was begun before is over
    assert not looks.compiled
    assert looks.poses(np.zeros(14)).shape == (len(known.scene.parts), 16)
    assert said == ["no numba"]


@pytest.mark.parametrize("name", robots.robot_names())
def test_the_tips_are_where_the_bench_has_them(name):
    looks = drawn_robot(name)
    q = np.stack([looks.robot.poses["home"], (looks.robot.lower + looks.robot.upper) / 2])
    tips = looks.fingertip_positions(looks.poses(q))
    assert tips.shape == (2, len(looks.robot.arms), 3)
    for row in range(2):
        for index, arm in enumerate(looks.robot.arms):
            wanted = tip_in_world(looks.robot, arm, q[row])[:3, 3]
            assert np.allclose(tips[row, index], wanted, atol=1e-5)


@pytest.mark.parametrize("name", robots.robot_names())
def test_every_number_has_a_name_and_a_unit(name):
    facts = drawn_robot(name).facts()
    assert len(facts["units"]) == len(facts["joint_names"])
    assert groups_of(facts["joint_names"]) == tuple(facts["groups"])


def test_a_robot_is_known_in_the_groups_that_a_station_has():
    whole, one = drawn_robot("agilex_piper"), drawn_robot("agilex_piper", ["right_arm"])
    assert (whole.robot.dim, one.robot.dim) == (14, 7)
    assert one.poses(np.zeros(7)).shape == (len(whole.scene.parts) // 2, 16)
    assert drawn_robot("agilex_piper", ["right_arm"]) is one


@pytest.mark.parametrize("name", ["", "nobody", "..", "../agilex_piper", "/etc"])
def test_only_robots_that_are_known_are_found(name):
    with pytest.raises(NotFound, match="agilex_piper"):
        drawn_robot(name)
    assert "does not exist" in describe_robot(name)["error"]


def test_groups_that_it_has_not_are_said():
    with pytest.raises(NotFound, match="tail"):
        drawn_robot("agilex_piper", ["left_arm", "tail"])


def test_a_description_that_cannot_be_read_is_a_sentence(tmp_path, monkeypatch):
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "robot.toml").write_text('title = "x"')
    monkeypatch.setenv("EVA_ROBOTS", str(tmp_path))
    found = describe_robot("broken")
    assert (found["joint_names"], found["groups"]) == ([], [])
    assert "robot.toml" in found["error"]
