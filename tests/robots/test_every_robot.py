"""What holds for every robot alike: its drawn shapes, its jaws, its postures, and what its arms reach."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import robots
from robots import load_robot
from robots.clearance import MARGIN
from tests.robots.standing import at_ready, declared_gap, extents, from_home_to_ready, mirror_error, unreached

EXTENTS = json.loads(Path(__file__).with_name("extents.json").read_text())  # of the published meshes [m]


@dataclass(frozen=True)
class Stands:
    """How a robot that stands behind the table has to be at its named postures, and how far its arms reach."""

    jaws: tuple[str, str]
    jaws_within: float  # m
    height: float  # of fingertips above the table on the way from home to ready, more than [m]
    off_vertical: float  # of fingers at ready, less than [deg]
    to_limit: float  # of joints at ready, more than [rad]
    tilt: float  # of fingers where a place is not reached straight from above [rad]
    mirror: tuple[float, float] | None  # the worst number of place and turn, less than; None: one arm


STANDING = {
    "arx_r5": Stands(("link7", "link8"), 1e-4, 0.14, 12, 0.25, 0.26, (1e-5, 3e-5)),
    "dual_franka": Stands(("panda_leftfinger", "panda_rightfinger"), 1e-4, 0.19, 1, 0.5, 0.26, (1e-8, 1e-8)),
    "ur5e": Stands(("left_finger_pad", "right_finger_pad"), 2e-4, 0.19, 1, 1.0, 0.0, None),
}
every_standing = pytest.mark.parametrize("name", STANDING)
robot = cache(load_robot)


@pytest.mark.some(3)
@pytest.mark.parametrize("name", EXTENTS)
def test_the_drawn_shapes_of_links_fill_the_extents_of_the_real_ones(name: str) -> None:
    for link, wanted in EXTENTS[name]["links"].items():
        np.testing.assert_allclose(
            extents(robot(name), link), wanted, rtol=0, atol=EXTENTS[name]["within"], err_msg=link
        )


@pytest.mark.parametrize("name", ["dual_franka", "ur5e"])
def test_limits_are_those_of_the_urdf(name: str) -> None:
    assert robot(name).overrides == ()
    assert "URDF" in robot(name).limits_source


@every_standing
def test_the_postures_of_two_arms_are_mirror_images(name: str) -> None:
    mirror = STANDING[name].mirror
    assert (mirror is None) == (len(robot(name).arms) == 1)
    for pose in ("home", "ready") if mirror else ():
        place, turn = mirror_error(robot(name), pose)
        assert (place < mirror[0], turn < mirror[1]) == (True, True)


@every_standing
def test_jaws_are_as_far_apart_as_the_gripper_says(name: str) -> None:
    of, stands = robot(name), STANDING[name]
    openings = (0.0, 1.0) if of.binary_dims else (0.0, 0.5, 1.0)
    gaps = [gap for opening in openings for gap in declared_gap(of, stands.jaws, opening)]
    assert len(gaps) == len(openings) * len(of.arms)
    for apart, said in gaps:
        assert apart == pytest.approx(said, abs=stands.jaws_within)


@pytest.mark.some(1)
@every_standing
def test_from_home_to_ready_nothing_touches_and_the_fingertips_stay_up(name: str) -> None:
    clearance, height = from_home_to_ready(robot(name))
    assert clearance > MARGIN
    assert height > STANDING[name].height


@every_standing
def test_ready_is_outside_of_the_workspace_fingers_down_and_away_from_limits(name: str) -> None:
    for ready in at_ready(robot(name)):
        assert ready.beside > 0.1
        assert ready.off_vertical < STANDING[name].off_vertical
        assert ready.to_limit > STANDING[name].to_limit
        assert ready.opened


@pytest.mark.exhaustive
@every_standing
def test_every_place_on_the_table_is_reached_from_above(name: str) -> None:
    assert unreached(robot(name), (0.02, 0.15), tilt=STANDING[name].tilt) == []


def test_a_robot_that_is_described_has_its_extents_checked() -> None:
    described = {path.parent.name for path in Path(robots.__file__).parent.glob("*/robot.toml")}
    assert described == set(EXTENTS)
