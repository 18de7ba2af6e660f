"""The Piper's numbers against poses from elsewhere: another program's, and what real arms reported."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from robots import load_robot

HOME = ([0.0] * 6, [0.056142472, -5.6e-08, 0.213193093], [0.737256126, 2.326e-06, 0.675613354, -4.995e-06])
LEFT = (
    [0.6848, 0.6745, -2.3976, -1.6873, 0.7644, 1.729],
    [-0.192737485, -0.23823533, 0.62991027],
    [0.840525911, 0.397566517, -0.029771476, 0.366838817],
)
RIGHT = (
    [-1.0014, 1.0567, -2.4292, -1.3113, 0.4163, 0.6165],
    [-0.073508342, 0.048724792, 0.721159201],
    [0.635867633, 0.213463921, 0.075552096, -0.7378329],
)


@pytest.mark.parametrize(
    ("arm", "check"), [("left_arm", HOME), ("left_arm", LEFT), ("right_arm", HOME), ("right_arm", RIGHT)]
)
def test_forward_kinematics_agrees_with_another_implementation(
    arm: str, check: tuple[list[float], list[float], list[float]]
) -> None:
    q, position, wxyz = check
    chain = load_robot("agilex_piper").group(arm).chain
    assert chain is not None
    pose = chain.pose(np.array(q))
    np.testing.assert_allclose(pose[:3], position, rtol=0, atol=2e-9)
    np.testing.assert_allclose(pose[3:], wxyz, rtol=0, atol=2e-9)


@pytest.mark.skipif("EVA_SAMPLE_EPISODE" not in os.environ, reason="EVA_SAMPLE_EPISODE is not set")
def test_forward_kinematics_of_recorded_joints_agrees_with_recorded_poses() -> None:
    import pyarrow.parquet

    file = next(Path(os.environ["EVA_SAMPLE_EPISODE"]).glob("data/*/*.parquet"))
    table = pyarrow.parquet.read_table(file, columns=["observation.qpos", "observation.eef"])
    qpos, recorded = (np.array(column.to_pylist(), dtype=np.float64) for column in table.columns)
    for index, arm in enumerate(load_robot("agilex_piper").arms):
        assert arm.chain is not None
        pose = arm.chain.pose(qpos[:, arm.joint_dims])
        wanted = recorded[:, 8 * index : 8 * index + 8]
        unit = wanted[:, 3:7] / np.linalg.norm(wanted[:, 3:7], axis=1, keepdims=True)
        turned = 4 * np.arcsin(np.linalg.norm(pose[:, 3:] - unit, axis=1) / 2)
        assert np.abs(pose[:, :3] - wanted[:, :3]).max() < 1e-4  # each axis; 1.13e-4 in all three together
        assert np.linalg.norm(pose[:, :3] - wanted[:, :3], axis=1).max() < 1.2e-4
        assert np.degrees(turned).max() < 0.03
        np.testing.assert_array_equal(wanted[:, 7], qpos[:, arm.gripper_dim])
