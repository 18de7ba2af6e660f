from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from robots import Robot, load_robot
from runtime.config.loader import load as load_deployment
from runtime.core.errors import ConfigurationError, PolicyError
from runtime.core.pose_format import CANONICAL, PoseFormat, reject_pose_format
from runtime.spaces.pose_rows import PoseRows
from tests.examples import some
from tests.runtime.odd_robot import odd_robot
from tests.runtime.spaces.test_frames import joints, some_vectors
from tests.runtime.spaces.test_orientations import ORDERS

PIPER = load_robot("agilex_piper")
BODY = load_robot("agibot_g2")

formats = st.one_of(
    st.builds(PoseFormat, orientation=st.sampled_from(["wxyz", "xyzw"]), gripper=st.booleans()),
    st.builds(
        PoseFormat, orientation=st.just("euler"), euler_order=st.sampled_from(ORDERS), degrees=st.booleans()
    ),
    st.builds(PoseFormat, orientation=st.just("rotation_vector"), degrees=st.booleans()),
    st.builds(PoseFormat, orientation=st.just("6d"), sixd=st.sampled_from(["columns", "rows"])),
)
frames = st.sampled_from(["", "base_link", "body_link1"])
groups = st.sampled_from([[], ["head"], ["body", "head"]])


@pytest.fixture(scope="module")
def odd(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return odd_robot(tmp_path_factory.mktemp("robots"))


@settings(max_examples=some(120))
@given(formats, frames, groups, st.integers(0, 1000))
def test_what_is_written_comes_back_exactly_in_every_format_and_frame(
    made: PoseFormat, frame: str, following: list[str], seed: int
) -> None:
    rows = PoseRows(made.model_copy(update={"frame": frame, "groups": following}), BODY)
    vectors, q = some_vectors(BODY, seed, 5), joints(BODY, seed, 5)
    written = rows.encode(vectors, q)
    assert written.shape == (5, rows.width)
    assert len(rows.names) == rows.width
    told, followed = rows.decode(written)
    back = rows.frame.resolve(told, q)
    np.testing.assert_allclose(back[..., :3], vectors[..., :3], atol=1e-9)
    first = Rotation.from_quat(vectors[..., 3:7].reshape(-1, 4), scalar_first=True)
    second = Rotation.from_quat(back[..., 3:7].reshape(-1, 4), scalar_first=True)
    assert (first.inv() * second).magnitude().max() < 1e-9
    np.testing.assert_allclose(np.linalg.norm(told[..., 3:7], axis=-1), 1.0, atol=1e-12)
    assert (told[0, :, 3] >= 0).all()
    assert ((told[1:, :, 3:7] * told[:-1, :, 3:7]).sum(axis=-1) >= 0).all()
    np.testing.assert_array_equal(told[..., 7], vectors[..., 7] if made.gripper else 0.0)
    np.testing.assert_array_equal(followed, q[:, rows.dims])


def test_the_canonical_format_is_the_vector_itself() -> None:
    rows, vectors = PoseRows(CANONICAL, PIPER), some_vectors(PIPER, 0, 1)
    assert rows.names == PIPER.eef_names
    np.testing.assert_allclose(rows.encode(vectors, joints(PIPER, 0)), vectors.reshape(1, 16), atol=1e-15)


@pytest.mark.parametrize(
    ("settings_", "width", "names"),
    [
        ({"orientation": "xyzw"}, 16, ["left_arm.qx", "left_arm.qy", "left_arm.qz", "left_arm.qw"]),
        ({"orientation": "euler", "euler_order": "ZYX"}, 14, ["left_arm.euler_Z1", "left_arm.euler_Y2"]),
        ({"orientation": "euler", "gripper": False}, 12, ["left_arm.euler_x1", "left_arm.euler_y2"]),
        ({"orientation": "rotation_vector"}, 14, ["left_arm.rx", "left_arm.ry", "left_arm.rz"]),
        ({"orientation": "6d"}, 20, ["left_arm.ax", "left_arm.ay", "left_arm.az", "left_arm.bx"]),
        ({"orientation": "6d", "gripper": False}, 18, ["left_arm.ax"]),
    ],
)
def test_every_number_of_a_row_has_a_name(settings_: dict[str, Any], width: int, names: list[str]) -> None:
    rows = PoseRows(PoseFormat(**settings_), PIPER)
    assert rows.width == width
    assert rows.names[3 : 3 + len(names)] == tuple(names)
    assert (rows.names[-1] == "right_arm.gripper") == settings_.get("gripper", True)


def test_joints_of_other_groups_follow_the_poses_in_the_order_they_are_named(odd: Robot) -> None:
    rows = PoseRows(PoseFormat(orientation="euler", groups=["hand", "neck"]), odd)
    assert rows.names[-5:] == ("armed.gripper", "hand.wrist", "hand.grasp", "neck.pan", "neck.tilt")
    assert rows.dims.tolist() == [15, 16, 0, 1]


def test_an_arm_without_a_gripper_writes_0_and_reads_nothing(odd: Robot) -> None:
    rows, vectors = PoseRows(CANONICAL, odd), some_vectors(odd, 0, 2)
    written = rows.encode(vectors, joints(odd, 0))
    np.testing.assert_array_equal(written[:, 7], 0.0)
    np.testing.assert_array_equal(written[:, 15], vectors[:, 1, 7])
    written[:, 7] = 5.0
    np.testing.assert_array_equal(rows.decode(written)[0][:, 0, 7], 0.0)


@settings(max_examples=some(30))
@given(formats, st.integers(0, 1000))
def test_rows_that_are_written_one_by_one_are_those_that_are_written_together(
    made: PoseFormat, seed: int
) -> None:
    rows = PoseRows(made, PIPER)
    vectors, q = some_vectors(PIPER, seed, 6), joints(PIPER, seed)
    together = rows.encode(vectors, q)
    previous = None
    for vector, expected in zip(vectors, together, strict=True):
        previous = rows.encode(vector[None], q, previous)[0]
        np.testing.assert_allclose(previous, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("settings_", "numbers", "said"),
    [
        (
            {"orientation": "xyzw"},
            [0, 0, 0, 1e-5],
            r"right_arm in row 2: qx, qy, qz, qw = 0, 0, 0, 1e-05; allowed: qx, qy, qz, qw of length 1",
        ),
        (
            {"orientation": "6d"},
            [1, 0, 0, 3, 0, 0],
            "right_arm in row 2: ax, ay, az, bx, by, bz = 1, 0, 0, 3, 0, 0; allowed: two vectors of length 1",
        ),
    ],
)
def test_numbers_without_an_orientation_are_named_with_arm_and_row(
    settings_: dict[str, Any], numbers: list[float], said: str
) -> None:
    rows = PoseRows(PoseFormat(**settings_), PIPER)
    written = rows.encode(some_vectors(PIPER, 0, 4), joints(PIPER, 0))
    first = rows.width // 2 + 3
    written[2, first : first + len(numbers)] = numbers
    with pytest.raises(PolicyError, match=f"the policy answered with no orientation for {said}"):
        rows.decode(written)


def test_measured_signs_are_kept_from_one_observation_to_the_next() -> None:
    rows, vectors = PoseRows(PoseFormat(orientation="xyzw"), PIPER), some_vectors(PIPER, 4, 1)
    vectors[0, :, 3:7] *= -np.sign(vectors[0, :, 3:4])
    written = rows.encode(2 * vectors, joints(PIPER, 0))
    np.testing.assert_allclose(written[0, 3:7], vectors[0, 0, [4, 5, 6, 3]], atol=1e-12)


@pytest.mark.parametrize(
    ("settings_", "said"),
    [
        (
            {"groups": ["left_arm"]},
            r"groups = \['left_arm'\]: 'left_arm' cannot follow.*head, body \(groups of",
        ),
        ({"groups": ["head", "head"]}, "'head' cannot follow the poses; allowed: each once"),
        ({"groups": ["tail"]}, "'tail' cannot follow"),
        ({"frame": "moon"}, "publication.pose.frame = 'moon'"),
    ],
)
def test_a_format_that_does_not_fit_the_robot_is_refused(settings_: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        PoseRows(PoseFormat(**settings_), BODY, "publication.pose")


@pytest.mark.parametrize(
    ("settings_", "said"),
    [
        ({"degrees": True}, 'degrees = True beside orientation = \'wxyz\'.*"euler" or "rotation_vector"'),
        ({"orientation": "6d", "euler_order": "ZYX"}, "euler_order = 'ZYX' beside orientation = '6d'"),
        ({"orientation": "euler", "sixd": "rows"}, "sixd = 'rows' beside"),
    ],
)
def test_a_key_that_the_orientation_has_no_use_for_is_refused(settings_: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        PoseFormat(**settings_)


def test_a_file_with_such_a_key_is_refused_by_its_name() -> None:
    file = Path(__file__).parents[3] / "deployments" / "tabletop.toml"
    said = r"policy.action_pose = .*: degrees = True beside orientation = '6d'"
    with pytest.raises(ConfigurationError, match=said):
        load_deployment(file, ["policy.action_pose.orientation=6d", "policy.action_pose.degrees=true"])


@pytest.mark.parametrize("order", ["xyZ", "xxy", "xy", "abc", "xyzx", ""])
def test_an_order_that_is_none_of_the_twelve_is_refused(order: str) -> None:
    with pytest.raises(ValidationError, match="euler_order"):
        PoseFormat(orientation="euler", euler_order=order)


def test_a_format_reads_itself_back_from_what_it_resolved_to() -> None:
    made = PoseFormat(
        orientation="euler", euler_order="XYX", degrees=True, frame="base_link", groups=["head"]
    )
    assert PoseFormat.model_validate(made.model_dump(mode="json")) == made
    assert str(made) == "euler XYX in degrees in base_link with head"


def test_a_format_for_a_space_of_joints_is_refused_with_what_was_given():
    reject_pose_format(PoseFormat(), "policy.action_pose")
    with pytest.raises(
        ConfigurationError, match=r"policy\.action_pose = \{'gripper': False\}.*no format, or.*\"eef\""
    ):
        reject_pose_format(PoseFormat(gripper=False), "policy.action_pose")
