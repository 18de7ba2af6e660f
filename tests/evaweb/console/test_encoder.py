"""What a station publishes as a page is shown it."""

from __future__ import annotations

import numpy as np
import pytest

from evaweb.console import frame_parts
from evaweb.console.encoder import StreamEncoder
from evaweb.core.binary_frames import decode
from evaweb.stations.robot_geometry import drawn_robot

Q = np.full(14, 0.1, np.float32)


def encoded(content, robot="agilex_piper", stream="joints"):
    made = StreamEncoder(robot).encode(stream, content)
    return decode(frame_parts.build_frame(made, 1, 0.0))


def joints(measured=Q, commanded=Q, engaged=True):
    return {"step": 3, "measured": measured, "commanded": commanded, "engaged": engaged}


def test_joints_become_numbers_and_the_poses_of_all_parts():
    frame = encoded(joints(commanded=Q + 0.1))
    assert frame.header["streams"]["joints"]["json"] == {"step": 3, "engaged": True}
    assert np.allclose(frame.array("joints", "commanded"), Q + 0.1)
    measured, commanded = frame.array("poses")
    assert measured.shape == (20, 16)
    assert not np.allclose(measured, commanded)


def test_what_the_policy_wants_and_what_is_planned_are_numbers_too():
    nothing = np.full(14, np.nan, np.float32)
    frame = encoded(joints() | {"raw": nothing, "planned": Q + 0.2})
    assert frame.header["streams"]["joints"]["json"] == {"step": 3, "engaged": True}
    assert np.isnan(frame.array("joints", "raw")).all()
    assert np.allclose(frame.array("joints", "planned"), Q + 0.2)


@pytest.mark.parametrize(
    "content", [joints(engaged=False), joints(commanded=np.full(14, np.nan, np.float32))]
)
def test_what_is_not_commanded_is_not_drawn(content):
    assert encoded(content).array("poses").shape == (20, 16)


def test_a_simulated_robot_is_the_third_that_is_drawn():
    real, simulated = encoded(joints()), encoded(joints() | {"simulated": Q + 0.2})
    assert real.array("poses").shape == (2, 20, 16)
    third = simulated.array("poses")[2]
    assert np.array_equal(simulated.array("poses")[:2], real.array("poses"))
    assert np.allclose(third, drawn_robot("agilex_piper").poses(Q + 0.2), atol=1e-6)


def test_beside_a_simulated_robot_what_is_not_commanded_is_no_pose():
    poses = encoded(joints(engaged=False) | {"simulated": Q}).array("poses")
    assert poses.shape == (3, 20, 16)
    assert np.isnan(poses[1]).all()
    assert np.array_equal(poses[0], poses[2])


def test_a_robot_that_is_not_simulated_is_not_drawn_as_such():
    assert len(encoded(joints() | {"simulated": np.full(14, np.nan, np.float32)}).array("poses")) == 2


@pytest.mark.parametrize(
    ("content", "robot"),
    [
        (joints(measured=np.full(14, np.nan, np.float32)), "agilex_piper"),
        (joints(measured=Q[:7], commanded=Q[:7]), "agilex_piper"),
        (joints(), "nobody"),
    ],
)
def test_what_cannot_be_drawn_is_still_told(content, robot):
    frame = encoded(content, robot)
    assert set(frame.header["streams"]) == {"joints", "recent"}


def test_a_robot_is_drawn_in_the_groups_that_its_station_says_it_has():
    encoder = StreamEncoder("agilex_piper")
    one = joints(measured=Q[:7], commanded=Q[:7])
    assert [part.stream for part in encoder.encode("joints", one)] == ["joints", "recent"]
    encoder.encode("state", {"facts": {"groups": ["right_arm"]}})
    poses = [part for part in encoder.encode("joints", one) if part.stream == "poses"]
    assert decode(frame_parts.build_frame(poses, 1, 0.0)).array("poses").shape == (2, 10, 16)
    assert encoder.looks is drawn_robot("agilex_piper", ["right_arm"])


@pytest.mark.parametrize("facts", [None, {}, {"groups": None}, {"groups": []}])
def test_a_station_that_does_not_say_has_all_groups(facts):
    encoder = StreamEncoder("agilex_piper")
    encoder.encode("state", {"facts": facts})
    assert encoder.looks is drawn_robot("agilex_piper")


def test_a_station_with_groups_that_nobody_knows_is_not_drawn():
    encoder = StreamEncoder("agilex_piper")
    encoder.encode("state", {"facts": {"groups": ["tail"]}})
    assert encoder.looks is None
    assert [part.stream for part in encoder.encode("joints", joints())] == ["joints", "recent"]


def test_events_and_link_are_no_parts():
    assert StreamEncoder("agilex_piper").encode("events", object()) == []
