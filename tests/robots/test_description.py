from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from robots import RobotError, load

Edit = Callable[..., Path]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("control_rate", "controlrate", "top level: unknown key controlrate; allowed: title, urdf,"),
        ("index = 6", "index = 6\nlenght = 3", "groups.0.gripper: unknown key lenght; allowed: index, unit,"),
        ("control_rate = 30.0", "control_rate = '30'", "control_rate = '30': Input should be a valid number"),
        ("control_rate = 30.0", "control_rate = -1.0", "control_rate = -1.0: Input should be greater than 0"),
        ("control_rate = 30.0", "control_rate = nan", "control_rate = nan: Input should be"),
        ("index = 6", "index = true", "groups.0.gripper.index = True: Input should be a valid integer"),
        ("binary = false", "binary = 0", "groups.0.gripper.binary = 0: Input should be a valid boolean"),
        (
            'urdf = "agilex_piper.urdf"',
            'urdf = "../other.urdf"',
            "urdf = '../other.urdf': String should match",
        ),
        ("limits_source", "# limits_source", "limits_source: required and absent"),
        ('front = "cam_high"', 'front = "cam/high"', "cameras.front = 'cam/high': String should match"),
        ("xyz = [-0.25, 0.0, 0.0]", "xyz = [-0.25, 0.0]", "groups.0.mount.xyz = [-0.25, 0.0]"),
    ],
)
def test_a_wrong_key_or_value_is_named_with_what_is_allowed(
    edited: Edit, old: str, new: str, said: str
) -> None:
    folder = edited((old, new))
    with pytest.raises(RobotError) as error:
        load(folder)
    assert said in str(error.value)
    assert str(folder / "robot.toml") in str(error.value)


def test_every_wrong_key_is_named_at_once(edited: Edit) -> None:
    folder = edited(("control_rate = 30.0", "control_rate = 0.0"), ("index = 6", "index = -1"))
    with pytest.raises(RobotError) as error:
        load(folder)
    assert "control_rate = 0.0" in str(error.value)
    assert "groups.0.gripper.index = -1" in str(error.value)


def test_a_file_that_is_no_toml_is_refused(edited: Edit) -> None:
    folder = edited(("[cameras]", "[cameras"))
    with pytest.raises(RobotError, match=r"robot\.toml: cannot be read as TOML"):
        load(folder)
