import math

import pytest

from runtime.clients.terminal import aim_text
from runtime.clients.terminal.syntax import parse
from runtime.core.errors import RuntimeFault
from runtime.ipc.command_arguments import AimRequest
from tests.runtime.terminal_station import AIM, Script

NAMES = ["a", "b", "grip"]


def wanted(*words):
    return aim_text.aim_arguments(Script(), parse(["bench-1", *words]))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["move", "--pose", "home"], {"pose": "home"}),
        (["move", "--joints", "1,-2,3"], {"joints": [1.0, -2.0, 3.0]}),
        (["aim", "--joint", "b=0.5"], {"joints": [0.1, 0.5, 0.05]}),
        (["move", "--joint", "a+=0.25", "grip-=0.05"], {"joints": [0.35, -0.2, 0.0]}),
        (
            ["jog", "left", "--xyz", "10,0,-5"],
            {"jog": {"arm": "left", "frame": "base", "translation": [0.01, 0, -0.005], "rotation": [0] * 3}},
        ),
        (
            ["aim", "--arm", "left", "--rpy", "0,0,180", "--frame", "tool"],
            {"jog": {"arm": "left", "frame": "tool", "translation": [0] * 3, "rotation": [0, 0, math.pi]}},
        ),
    ],
)
def test_what_was_said_is_what_the_station_reads(words, expected):
    found = wanted(*words)
    assert found == {
        key: pytest.approx(value) if key == "joints" else value for key, value in expected.items()
    }
    AimRequest.model_validate(found)


def test_a_joint_that_the_robot_has_not_is_named_with_those_that_it_has():
    with pytest.raises(RuntimeFault, match="joint 'elbow' is none of the robot's; it has a, b, grip"):
        wanted("move", "--joint", "elbow=1")


def test_a_target_is_told_joint_by_joint():
    aim = AIM | {"joints": [0.1001, 0.2, 0.05]}
    assert aim_text.aim_lines(aim, AIM["joints"], NAMES, 0.5) == [
        "  b                        -0.2000 -> +0.2000",
        "  at most 0.200 rad, in up to 3.0 s",
    ]
    assert aim_text.aim_lines(AIM, AIM["joints"], NAMES, 1.0)[0] == "  no joint would move"


def test_what_is_not_as_asked_is_told():
    aim = AIM | {"clipped": ["b"], "reached": False, "position_error_mm": 12.3, "rotation_error_deg": 4.56}
    assert aim_text.aim_problem(AIM) == ""
    assert (
        aim_text.aim_problem(aim) == "stopped by the limits of b; 12.3 mm and 4.6 degrees away from the pose"
    )
    assert aim_text.aim_lines(aim, AIM["joints"], NAMES, 1.0)[-1].startswith("  NOT AS ASKED: stopped by")
