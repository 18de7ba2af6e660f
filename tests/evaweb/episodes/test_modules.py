"""What Replay's modules make of numbers: run by Node, as a browser runs them."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

NODE = shutil.which("node")
REPLAY = Path(__file__).parents[3] / "static" / "replay"
pytestmark = pytest.mark.skipif(NODE is None, reason="Node is not installed: the page's modules are not run")


def run(module: str, body: str) -> Any:
    """What `body` returns, where `m` is the module."""
    address = json.dumps((REPLAY / module).as_uri())
    script = f"const m = await import({address}); console.log(JSON.stringify((() => {{ {body} }})()));"
    found = subprocess.run(
        [str(NODE), "--input-type=module", "-e", script], capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stderr
    return json.loads(found.stdout)


def test_the_joints_that_move_farthest_come_first_and_a_gripper_counts() -> None:
    values = "Float32Array.from([0, 0.1, NaN, 0, 0, 0, 0, 0.9, 0.2, 0, 0.05, 0])"  # three rows of four joints
    units = '["rad", "rad", "rad", "m"]'
    assert run("moving.js", f"return m.movingMost({values}, 4, {units});") == [2, 3, 0, 1]


def test_the_pointer_on_the_axis_is_at_the_row_where_its_thumb_would_be() -> None:
    found = run("hover.js", "return [0, 8, 108, 207.9, 400].map((x) => m.rowAt(x, 216, 100));")
    assert found == [0, 0, 50, 99, 99]


def test_a_rows_picture_is_found_on_its_sheet() -> None:
    grid = "{ every: 4, across: 10, down: 10 }"
    found = run("hover.js", f"return [0, 3, 4, 39, 40, 399].map((row) => m.tileAt(row, {grid}));")
    places = [(round(one["x"]), round(one["y"])) for one in found]
    assert places == [(0, 0), (0, 0), (11, 0), (100, 0), (0, 11), (100, 100)]
    single = run("hover.js", "return m.tileAt(0, { every: 1, across: 1, down: 1 });")
    assert single == {"x": 0, "y": 0}


def test_a_place_on_the_lane_is_a_row_of_the_episode_wherever_the_pointer_is() -> None:
    found = run("segment_lane.js", "return [-5, 0, 199, 200, 999].map((x) => m.rowOn(x, 200, 40));")
    assert found == [0, 0, 39, 39, 39]
