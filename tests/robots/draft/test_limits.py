from __future__ import annotations

from pathlib import Path

import pytest

from robots import urdf
from robots.description import OverrideTable
from robots.draft.limits import placeholder_limits
from tests.robots.draft.urdfs import LIMIT, base, joint, link, write


def of(folder: Path, more: str, kind: str = "revolute") -> OverrideTable | None:
    body = base() + link("a") + joint("j", "base_link", "a", kind=kind, more=more)
    return placeholder_limits(urdf.read(write(folder, body)).joint("j"))


def test_limits_that_can_be_meant_stay(tmp_path: Path) -> None:
    assert of(tmp_path, LIMIT) is None
    assert (
        of(tmp_path, '<limit lower="-6.28318" upper="6.28318" velocity="3.14"/>') is None
    )  # turns twice round


@pytest.mark.parametrize(
    ("more", "kind", "wanted", "why"),
    [
        (
            "",
            "continuous",
            (-3.1416, 3.1416, 1.0),
            "turns without end in the URDF and the URDF gives no velocity",
        ),
        ('<limit velocity="2"/>', "continuous", (-3.1416, 3.1416, None), "turns without end"),
        ('<limit velocity="2"/>', "revolute", (-3.1416, 3.1416, None), "gives no range"),
        ('<limit lower="0" upper="0" velocity="2"/>', "revolute", (-3.1416, 3.1416, None), "range is 0 to 0"),
        (
            '<limit lower="-10" upper="10" velocity="2"/>',
            "revolute",
            (-3.1416, 3.1416, None),
            "-10 to 10 rad is no",
        ),
        ('<limit lower="-1" upper="1"/>', "revolute", (None, None, 1.0), "gives no velocity"),
        ('<limit lower="-1" upper="1" velocity="0"/>', "revolute", (None, None, 1.0), "gives no velocity"),
        ('<limit lower="-1" upper="1" velocity="1000"/>', "revolute", (None, None, 1.0), "1000/s is faster"),
        (
            '<limit lower="0" upper="0"/>',
            "prismatic",
            (-0.5, 0.5, 0.1),
            "range is 0 to 0 and the URDF gives no vel",
        ),
    ],
)
def test_others_are_replaced_by_placeholders_that_say_so(
    tmp_path: Path, more: str, kind: str, wanted: tuple[float | None, ...], why: str
) -> None:
    found = of(tmp_path, more, kind)
    assert found is not None
    assert (found.lower, found.upper, found.velocity) == wanted
    assert why in found.reason
    assert found.reason.endswith("a placeholder, verify it on the robot")
