"""What the 3D scene is given."""

from __future__ import annotations

import json

import numpy as np
import pytest

import robots
from evaweb.errors import NotFound
from evaweb.stations.geometry import BENCH, TABLE, facts_of, geometry, looks_of
from evaweb.stations.models import Station
from runtime.sim.bench import Bench, tip_in_world


def test_a_robot_has_parts_shapes_and_a_pose_to_begin_with():
    found = geometry("agilex_piper", simulated=False)
    assert json.loads(json.dumps(found)) == found
    assert len(found["home"]) == len(found["parts"])
    assert {visual["part"] for visual in found["visuals"]} <= set(range(len(found["parts"])))
    assert all(len(visual["origin"]) == 16 for visual in found["visuals"])
    assert found["bench"] is None


def test_matrices_go_column_by_column():
    looks = looks_of("agilex_piper")
    q = np.asarray(looks.robot.poses["home"])
    poses = looks.poses(np.stack([q, q]))
    assert poses.shape == (2, len(looks.scene.parts), 16)
    assert poses.dtype == np.float32
    assert np.allclose(poses[0, 3].reshape(4, 4).T, looks.scene.poses(q)[3], atol=1e-6)


def test_the_tips_are_where_the_bench_has_them():
    looks = looks_of("agilex_piper")
    q = np.asarray(looks.robot.poses["home"])
    parts = looks.scene.poses(q)
    tips = geometry("agilex_piper", simulated=True)["tips"]
    assert len(tips) == len(looks.robot.arms)
    for tip, arm in zip(tips, looks.robot.arms, strict=True):
        pose = parts[tip["part"]] @ np.reshape(tip["pose"], (4, 4)).T
        assert np.allclose(pose, tip_in_world(looks.robot, arm, q), atol=1e-6)


def test_the_bench_that_is_drawn_is_the_one_that_is_simulated():
    bench = Bench()
    for size in ("block_edge", "plate_radius", "plate_height"):
        assert BENCH[size] == getattr(bench, size)
    assert BENCH["area"] == list(bench.area)
    colours = {
        "plate_colour": bench.plate_colour,
        "plate_rim_colour": bench.plate_rim_colour,
    }
    for name, colour in colours.items():
        assert [round(255 * part) for part in BENCH[name]] == [*colour, 255]
    drawn = [tuple(round(255 * part) for part in colour[:3]) for colour in BENCH["block_colours"]]
    assert tuple(drawn) == bench.block_colours
    assert tuple(round(255 * part) for part in TABLE["colour"][:3]) == bench.table_colour


@pytest.mark.parametrize("name", ["nobody", "../robots/agilex_piper", "/etc", ""])
def test_a_robot_that_there_is_not_never_reaches_the_disk(name):
    with pytest.raises(NotFound, match="there are: agilex_piper"):
        looks_of(name)
    assert "does not exist" in facts_of(name)["error"]


@pytest.mark.django_db
def test_the_addresses_answer_who_is_logged_in(client, vera):
    Station.objects.create(name="bench-9", robot="agilex_piper", simulated=True)
    assert client.get("/stations/bench-9/geometry").status_code == 302
    client.force_login(vera)
    assert client.get("/stations/bench-9/geometry").json()["bench"] == BENCH
    assert client.get("/robots/agilex_piper/geometry").json()["bench"] is None
    assert client.get("/stations/nowhere/geometry").status_code == 404
    assert client.get("/robots/nobody/geometry").status_code == 404
    assert robots.names() == ("agilex_piper",)
