from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from runtime.core.types import ActionMode, RelativeFrame
from runtime.spaces.pose_rows import continuous_quaternions
from runtime.spaces.relative_poses import to_absolute
from tests.examples import some


def quarter_turned(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """One arm that stands turned by 90 degrees about z, and offsets of 0.1 m along x."""
    start = np.array([[1.0, 2.0, 3.0, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5), 0.02]])
    offset = np.array([0.1, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.05])
    return start, np.tile(offset, (rows, 1, 1))


@pytest.mark.parametrize(
    ("mode", "frame", "expected"),
    [
        ("relative", "base", [[1.1, 2.0], [1.1, 2.0]]),
        ("relative", "tool", [[1.0, 2.1], [1.0, 2.1]]),
        ("delta", "base", [[1.1, 2.0], [1.2, 2.0]]),
        ("delta", "tool", [[1.0, 2.1], [1.0, 2.2]]),
    ],
)
def test_offsets_lie_along_the_base_or_along_the_tool(
    mode: ActionMode, frame: RelativeFrame, expected: list[list[float]]
) -> None:
    start, offsets = quarter_turned(2)
    made = to_absolute(offsets, start, mode, frame)
    np.testing.assert_allclose(made[:, 0, :2], expected, atol=1e-12)
    np.testing.assert_array_equal(made[:, 0, 7], [0.05, 0.05])


@pytest.mark.parametrize(("frame", "side"), [("base", -1.0), ("tool", 1.0)])
def test_a_turn_is_about_the_axes_of_its_frame(frame: RelativeFrame, side: float) -> None:
    start, offsets = quarter_turned(1)
    offsets[0, 0, 3:7] = [np.cos(0.1), np.sin(0.1), 0, 0]
    made = to_absolute(offsets, start, "relative", frame)[0, 0, 3:7]
    expected = np.sqrt(0.5) * np.array([np.cos(0.1), np.sin(0.1), side * np.sin(0.1), np.cos(0.1)])
    np.testing.assert_allclose(made, expected, atol=1e-12)


unit = arrays(np.float64, (30, 2, 4), elements=st.floats(-1, 1)).map(
    lambda q: np.where(np.linalg.norm(q, axis=-1, keepdims=True) < 0.01, [1.0, 0, 0, 0], q)
)


@settings(max_examples=some(25))
@given(unit, st.sampled_from(["relative", "delta"]), st.sampled_from(["base", "tool"]))
def test_absolute_poses_are_unit_and_continuous(
    quaternions: np.ndarray, mode: ActionMode, frame: RelativeFrame
) -> None:
    vectors = np.zeros((30, 2, 8))
    vectors[..., 3:7] = continuous_quaternions(
        quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    )
    made = to_absolute(vectors, vectors[0], mode, frame)[..., 3:7]
    np.testing.assert_allclose(np.linalg.norm(made, axis=-1), 1.0, atol=1e-12)
    assert ((made[1:] * made[:-1]).sum(axis=-1) >= -1e-12).all()
    assert (made[0, :, 0] >= 0).all()


@settings(max_examples=some(25))
@given(unit, st.integers(1, 30), st.sampled_from(["base", "tool"]))
def test_steps_amount_to_what_they_are_one_after_the_other(
    quaternions: np.ndarray, count: int, frame: RelativeFrame
) -> None:
    vectors = np.random.default_rng(count).uniform(-1, 1, (count, 2, 8))
    vectors[..., 3:7] = quaternions[:count] / np.linalg.norm(quaternions[:count], axis=-1, keepdims=True)
    start = np.array([[0.1, 0.2, 0.3, 0.5, 0.5, -0.5, 0.5, 0.0], [0, 0, 0, 0, 1.0, 0, 0, 0.0]])
    made = to_absolute(vectors, start, "delta", frame)
    for arm in (0, 1):
        position, turn = start[arm, :3], Rotation.from_quat(start[arm, 3:7], scalar_first=True)
        for row, step in zip(made[:, arm], vectors[:, arm], strict=True):
            by = Rotation.from_quat(step[3:7], scalar_first=True)
            position = position + (turn.apply(step[:3]) if frame == "tool" else step[:3])
            turn = turn * by if frame == "tool" else by * turn
            np.testing.assert_allclose(row[:3], position, atol=1e-9)
            assert (turn.inv() * Rotation.from_quat(row[3:7], scalar_first=True)).magnitude() < 1e-9
            assert row[7] == step[7]
