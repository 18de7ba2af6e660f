"""`python -m runtime DEPLOYMENT --check` says what a station would die of."""

from __future__ import annotations

from pathlib import Path

import pytest

from runtime import __main__ as command_line

DEPLOYMENTS = Path(__file__).parents[2] / "deployments"
IN_POSES = str(DEPLOYMENTS / "tabletop_agilex_piper_eef.toml")


@pytest.mark.parametrize(
    ("assignment", "said"),
    [
        ('policy.action_pose={frame="nowhere"}', "policy.action_pose.frame = 'nowhere' is no frame of"),
        ('policy.action_pose={frame="link6"}', "'link6' moves with left_arm"),
        ('policy.action_pose={groups=["head"]}', "'head' cannot follow the poses"),
        ('publication.space="eef"', "publication.space = 'eef' with transport 'zmq'"),
        ('groups=["left"]', "groups ['left'] were chosen; allowed: left_arm, right_arm"),
    ],
)
@pytest.mark.parametrize("how", [["--check"], []])
def test_what_does_not_fit_the_robot_ends_before_anything_starts(
    assignment: str, said: str, how: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = f'data_dir="{tmp_path}"'
    assert command_line.main([IN_POSES, "--set", assignment, "--set", data, *how]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("file", sorted(DEPLOYMENTS.glob("tabletop*.toml")), ids=lambda file: file.stem)
def test_deployments_that_come_along_fit(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command_line.main([str(file), "--check"]) == 0
    assert "ok: " in capsys.readouterr().out


@pytest.mark.parametrize("file", ["tabletop.toml", "ros2_r1_lite.toml", "tabletop_ros1.toml"])
def test_lockstep_refuses_what_goes_on_in_real_time_before_anything_is_connected(
    file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = ["--set", f'data_dir="{tmp_path}"']
    assert command_line.main([str(DEPLOYMENTS / file), *data, "--lockstep"]) == 2
    said = capsys.readouterr().err
    assert "with --lockstep: its other end runs in real time" in said
    assert "allowed: dataset, or leave --lockstep out" in said
    assert not list(tmp_path.iterdir())
