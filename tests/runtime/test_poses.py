from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from runtime.errors import PolicyError
from runtime.poses import absolute, canonical
from runtime.types import ActionMode, RelativeFrame


@settings(max_examples=50)
@given(st.lists(st.lists(st.floats(-1, 1), min_size=4, max_size=4), min_size=1, max_size=8))
def test_canonical_vectors_are_unit_continuous_and_start_with_w_not_negative(rows: list[list[float]]) -> None:
    quaternions = np.array(rows)[:, None]
    quaternions[np.linalg.norm(quaternions, axis=-1) < 0.01] = [1, 0, 0, 0]
    vectors = np.concatenate([np.zeros((len(rows), 1, 3)), quaternions, np.zeros((len(rows), 1, 1))], axis=-1)
    result = canonical(vectors)[..., 3:7]
    np.testing.assert_allclose(np.linalg.norm(result, axis=-1), 1.0, atol=1e-12)
    assert result[0, 0, 0] >= 0
    assert ((result[1:] * result[:-1]).sum(axis=-1) >= 0).all()
    lengths = np.linalg.norm(quaternions, axis=-1)
    np.testing.assert_allclose(np.abs((result * quaternions).sum(axis=-1)), lengths, atol=1e-12)


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
    made = absolute(offsets, start, mode, frame)
    np.testing.assert_allclose(made[:, 0, :2], expected, atol=1e-12)
    np.testing.assert_array_equal(made[:, 0, 7], [0.05, 0.05])


@pytest.mark.parametrize(("frame", "side"), [("base", -1.0), ("tool", 1.0)])
def test_a_turn_is_about_the_axes_of_its_frame(frame: RelativeFrame, side: float) -> None:
    start, offsets = quarter_turned(1)
    offsets[0, 0, 3:7] = [np.cos(0.1), np.sin(0.1), 0, 0]
    made = absolute(offsets, start, "relative", frame)[0, 0, 3:7]
    expected = np.sqrt(0.5) * np.array([np.cos(0.1), np.sin(0.1), side * np.sin(0.1), np.cos(0.1)])
    np.testing.assert_allclose(made, expected, atol=1e-12)


unit = arrays(np.float64, (30, 2, 4), elements=st.floats(-1, 1)).map(
    lambda q: np.where(np.linalg.norm(q, axis=-1, keepdims=True) < 0.01, [1.0, 0, 0, 0], q)
)


@settings(max_examples=25)
@given(unit, st.sampled_from(["relative", "delta"]), st.sampled_from(["base", "tool"]))
def test_absolute_poses_are_unit_and_continuous(
    quaternions: np.ndarray, mode: ActionMode, frame: RelativeFrame
) -> None:
    vectors = np.zeros((30, 2, 8))
    vectors[..., 3:7] = quaternions
    vectors = canonical(vectors)
    made = absolute(vectors, vectors[0], mode, frame)[..., 3:7]
    np.testing.assert_allclose(np.linalg.norm(made, axis=-1), 1.0, atol=1e-12)
    assert ((made[1:] * made[:-1]).sum(axis=-1) >= -1e-12).all()


def test_whose_quaternion_has_no_direction_is_said() -> None:
    with pytest.raises(
        PolicyError, match=r"the robot measured quaternion \[0.0, 0.0, 0.0, 0.0\], arm 1, row 0"
    ):
        canonical(np.array([[[0, 0, 0, 1.0, 0, 0, 0, 0], [0.0] * 8]]), "the robot measured")
