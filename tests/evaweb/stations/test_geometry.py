"""What the 3D scene is given."""

from __future__ import annotations

import json

import numpy as np
import pytest

import robots
from evaweb.core.errors import NotFound
from evaweb.stations.geometry import scene_geometry
from evaweb.stations.models import Station
from evaweb.stations.robot_geometry import drawn_robot
from runtime.benches.appearance import describe_appearance
from runtime.benches.schema import load_schema


@pytest.mark.parametrize("name", robots.robot_names())
def test_a_robot_has_parts_shapes_and_a_pose_to_begin_with(name):
    found = scene_geometry(name)
    assert json.loads(json.dumps(found)) == found
    assert len(found["home"]) == len(found["parts"])
    parts = range(len(found["parts"]))
    assert {visual["part"] for visual in found["visuals"]} <= set(parts)
    assert all(len(visual["origin"]) == 16 for visual in found["visuals"])
    assert all(one["part"] in parts and one["radius"] > 0 for one in found["capsules"])
    assert found["bench"] is None


@pytest.mark.parametrize("name", robots.robot_names())
def test_end_effectors_and_the_frames_of_their_poses_are_frames(name):
    looks = drawn_robot(name)
    frames = scene_geometry(name)["frames"]
    ends = [frame for frame in frames if frame["kind"] == "end"]
    for frame, arm in zip(ends, looks.robot.arms, strict=True):
        assert frame["name"].removeprefix(f"{arm.name}/") == arm.eef_link
    names = [frame["name"] for frame in frames]
    assert len(set(names)) == len(names)
    references = {frame["part"] for frame in frames if frame["kind"] == "reference"} - {None}
    assert references == {looks.scene.link_of(arm.name, arm.frame) for arm in looks.robot.arms}


@pytest.mark.parametrize("name", robots.robot_names())
def test_a_pose_of_an_arm_leads_from_its_frame_to_its_end_effector(name):
    looks = drawn_robot(name)
    frames = scene_geometry(name)["frames"]
    q = np.asarray(looks.robot.poses["home"])
    parts = looks.scene.poses(q)
    for frame, arm in zip(frames, looks.robot.arms, strict=False):
        base = parts[looks.scene.link_of(arm.name, arm.frame)]
        assert np.allclose(np.linalg.inv(base) @ parts[frame["part"]], arm.transform(q), atol=1e-6)


def test_the_frame_of_all_mounts_stands_still():
    robot = drawn_robot("dual_franka").robot
    (stand,) = [one for one in scene_geometry("dual_franka")["frames"] if one["part"] is None]
    assert stand["name"] == robot.mount_frame
    assert np.allclose(stand["pose"][12:15], robot.stand[:3])


def test_fewer_groups_are_fewer_parts():
    one = scene_geometry("agilex_piper", ["left_arm"])
    assert one["groups"] == ["left_arm"]
    assert len(one["parts"]) == len(scene_geometry("agilex_piper")["parts"]) / 2
    with pytest.raises(NotFound, match="tail"):
        scene_geometry("agilex_piper", ["tail"])


@pytest.mark.django_db
def test_pages_fetch_it_by_station_and_by_robot(client, django_user_model):
    Station.objects.create(name="bench-9", robot="agilex_piper", simulated=True)
    assert client.get("/stations/bench-9/geometry").status_code == 302
    client.force_login(django_user_model.objects.create_user("ann"))
    assert client.get("/stations/bench-9/geometry").json()["bench"] == describe_appearance(
        load_schema("tabletop")
    )
    assert client.get("/stations/bench-9/geometry?groups=right_arm").json()["groups"] == ["right_arm"]
    assert client.get("/robots/agilex_piper/geometry").json()["bench"] is None
    for address in (
        "/stations/nowhere/geometry",
        "/stations/bench-9/geometry?groups=tail",
        "/robots/nobody/geometry",
        "/robots/agilex_piper/geometry?groups=left_arm,,",
    ):
        assert client.get(address).status_code == 404
