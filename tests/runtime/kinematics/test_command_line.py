from __future__ import annotations

import robots
from runtime.kinematics.__main__ import main


def test_every_robot_is_made_ready_and_named(capsys):
    assert main([]) == 0
    said = capsys.readouterr().out
    assert [line.split(":")[0] for line in said.splitlines()] == list(robots.robot_names())


def test_a_robot_that_does_not_exist_is_named_with_those_that_do(capsys):
    assert main(["agilex_piper", "hal"]) == 1
    captured = capsys.readouterr()
    assert captured.out.startswith("agilex_piper: ready after")
    assert "no robot 'hal'; known: agibot_g2" in captured.err
