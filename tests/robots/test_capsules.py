"""Capsules cover what they stand for, and not much more."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robots
from robots import RobotError
from robots.capsules import PIECES, Capsule, capsules, covering_capsules, smallest_capsule
from robots.rotations import Float64, matrix_of_rpy
from robots.shapes import PLAIN, Shape
from robots.shapes import read_shapes as drawn
from tests.robots.conftest import Edit

length = st.floats(0.01, 0.4)
KINDS = {"box": 3, "cylinder": 2, "sphere": 1}


@st.composite
def shapes(draw: st.DrawFn) -> Shape:
    kind = draw(st.sampled_from(sorted(KINDS)))
    origin = np.eye(4)
    origin[:3, :3] = matrix_of_rpy(*draw(st.tuples(*[st.floats(-3, 3)] * 3)))
    origin[:3, 3] = draw(st.tuples(*[st.floats(-0.5, 0.5)] * 3))
    return Shape("link", kind, draw(st.tuples(*[length] * KINDS[kind])), origin, PLAIN)


def surface(shape: Shape, count: int = 400) -> Float64:
    """Points [n, 3] on the shape, in the link."""
    rng = np.random.default_rng(0)
    if shape.kind == "box":
        points = rng.uniform(-0.5, 0.5, (count, 3))
        points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-0.5, 0.5], count)
        points = np.concatenate([points, np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T])
        points *= shape.size
    else:
        points = rng.normal(size=(count, 3))
        points *= shape.size[0] / np.linalg.norm(points, axis=1, keepdims=True)
        if shape.kind == "cylinder":
            points[:, :2] *= shape.size[0] / np.linalg.norm(points[:, :2], axis=1, keepdims=True)
            points[:, 2] = rng.choice([-0.5, 0.5], count) * shape.size[1]
    return np.asarray(points @ shape.origin[:3, :3].T + shape.origin[:3, 3])


def depth(points: Float64, capsule: Capsule) -> Float64:
    """How far inside the capsule each point is."""
    way = capsule.end - capsule.start
    along = np.clip((points - capsule.start) @ way / max(way @ way, 1e-12), 0, 1)
    nearest = capsule.start + along[:, None] * way
    return np.asarray(capsule.radius - np.linalg.norm(points - nearest, axis=1))


@given(st.lists(shapes(), min_size=1, max_size=4))
def test_one_capsule_covers_every_shape_whole(shown: list[Shape]) -> None:
    capsule = smallest_capsule(shown)
    for shape in shown:
        assert depth(surface(shape), capsule).min() > -1e-9


@given(st.lists(shapes(), min_size=1, max_size=5))
def test_the_capsules_of_a_link_cover_each_of_its_shapes_and_are_few(shown: list[Shape]) -> None:
    made = covering_capsules(shown)
    assert 1 <= len(made) <= PIECES
    for shape in shown:
        assert max(depth(surface(shape), capsule).min() for capsule in made) > -1e-9


def test_what_is_round_is_hugged() -> None:
    rod = smallest_capsule([Shape("link", "cylinder", (0.05, 0.4), np.eye(4), PLAIN)])
    assert rod.radius == pytest.approx(0.05, rel=0.01)
    assert np.allclose([rod.start[:2], rod.end[:2]], 0, atol=1e-6)
    assert rod.end[2] - rod.start[2] <= 0.4 + 1e-9
    ball = smallest_capsule([Shape("link", "sphere", (0.1,), np.eye(4), PLAIN)])
    assert (ball.radius, ball.start.tolist(), ball.end.tolist()) == (0.1, [0, 0, 0], [0, 0, 0])


def test_a_link_round_a_corner_is_two_thin_capsules_and_not_a_fat_one() -> None:
    arm, forearm = np.eye(4), np.eye(4)
    arm[:3, 3], forearm[:3, 3] = (0.2, 0, 0), (0, 0, 0.2)
    shown = [
        Shape("link", "box", (0.4, 0.06, 0.06), arm, PLAIN),
        Shape("link", "box", (0.06, 0.06, 0.4), forearm, PLAIN),
    ]
    assert (
        max(capsule.radius for capsule in covering_capsules(shown)) < 0.045 < smallest_capsule(shown).radius
    )


def test_a_link_has_the_capsule_that_its_robot_declares_or_none(edited: Edit) -> None:
    declared = """capsules.link1 = { start = [0.0, 0.0, -0.1], end = [0.0, 0.0, 0.1], radius = 0.2 }
without = ["link5"]
ignore = ["""
    robot = robots.load_robot(edited(("ignore = [", declared)))
    made = capsules(robot)
    (own,) = made["link1"]
    assert (own.start.tolist(), own.end.tolist(), own.radius) == ([0, 0, -0.1], [0, 0, 0.1], 0.2)
    assert "link5" not in made
    assert set(made) == set(capsules(robots.load_robot("agilex_piper"))) - {"link5"}


@pytest.mark.parametrize(
    ("name", "link"),
    [
        ("r1_lite", "torso_link3"),
        ("agibot_g2", "body_link5"),
        ("agibot_g2", "arm_l_link3"),
        ("agibot_g2", "arm_r_link3"),
        ("dual_franka", "panda_link5"),
    ],
)
def test_capsules_that_are_declared_of_a_link_cover_its_shapes(name: str, link: str) -> None:
    robot = robots.load_robot(name)
    made = capsules(robot)[link]
    assert len(made) == len(robot.collision.capsules[link])
    for shape in drawn(robot.urdf):
        if shape.link == link:
            inside = np.max([depth(surface(shape, 4000), capsule) for capsule in made], axis=0)
            assert inside.min() > 0, shape


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ('without = ["elbow"]', "collision.without names elbow; allowed: base_link, "),
        (
            "capsules.elbow = { start = [0.0, 0.0, 0.0], end = [0.0, 0.0, 0.0], radius = 0.1 }",
            "collision.capsules names elbow; allowed: base_link, ",
        ),
        (
            'ignore = [["link2", "floor"]]',
            "collision.ignore names floor; allowed: table, a link, or GROUP/LINK",
        ),
        ('ignore = [["link2"]]', "collision.ignore"),
        (
            "capsules.link1 = { start = [0.0, 0.0, 0.0], end = [0.0, 0.0, 0.0], radius = 0.0 }",
            "collision.capsules.link1.0.radius = 0.0",
        ),
        (
            "capsules.link1 = []",
            "collision.capsules.link1 = []: Value should have at least 1 item",
        ),
    ],
)
def test_a_link_that_there_is_not_is_named_with_file_and_key(
    tmp_path: Path, edited: Edit, table: str, said: str
) -> None:
    folder = edited()
    file = folder / "robot.toml"
    head = file.read_text().partition("[collision]")[0]
    file.write_text(f"{head}\n[collision]\n{table}\n")
    with pytest.raises(RobotError) as error:
        robots.load_robot(folder)
    assert str(file) in str(error.value)
    assert said in str(error.value)
