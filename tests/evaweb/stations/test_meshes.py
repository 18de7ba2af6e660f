"""Meshes: served by what they contain, never by where they lie."""

from __future__ import annotations

import shutil
import struct
from hashlib import sha256

import pytest

import robots
from evaweb.core.errors import NotFound
from evaweb.stations import robot_geometry as looks
from evaweb.stations.geometry import scene_geometry
from evaweb.stations.meshes import mesh_content

PIPER = robots.load_robot("agilex_piper").folder
CORNERS = ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.2, 0.3))


def stl(*triangles):
    """A binary STL."""
    rows = b"".join(struct.pack("<12fH", 0, 0, 1, *sum(triangle, ()), 0) for triangle in triangles)
    return bytes(80) + struct.pack("<I", len(triangles)) + rows


@pytest.fixture
def meshed(tmp_path, monkeypatch):
    """Robot `meshed`, a Piper whose base_link is shown by a mesh; the folder of that mesh."""
    folder = tmp_path / "robots" / "meshed"
    shutil.copytree(PIPER, folder)
    shapes = tmp_path / "meshes" / "meshed"
    shapes.mkdir(parents=True)
    (shapes / "base_link.stl").write_bytes(stl(CORNERS))
    (shapes / "secret.stl").write_bytes(stl(CORNERS, CORNERS))
    monkeypatch.setenv("EVA_ROBOTS", str(tmp_path / "robots"))
    monkeypatch.setenv("EVA_ROBOT_MESHES", str(tmp_path / "meshes"))
    looks._drawn_robot.cache_clear()
    yield shapes
    looks._drawn_robot.cache_clear()


def shown(name="meshed"):
    return [visual for visual in scene_geometry(name)["visuals"] if visual["kind"] == "mesh"]


def test_a_mesh_has_an_address_and_a_box_that_stands_for_it(meshed):
    left, right = shown()
    assert left["address"] == right["address"]
    assert left["part"] != right["part"]
    assert (left["format"], left["size"]) == ("stl", [1.0, 1.0, 1.0])
    assert left["box"]["size"] == pytest.approx([0.1, 0.2, 0.3])
    assert left["box"]["origin"][12:15] == pytest.approx([0.05, 0.1, 0.15])
    assert str(meshed) not in str(shown())


def test_a_mesh_is_found_by_its_content_alone(meshed):
    content = (meshed / "base_link.stl").read_bytes()
    digest = sha256(content).hexdigest()
    assert mesh_content(robot="meshed", digest=digest) == content
    for robot, wanted in (
        ("meshed", sha256((meshed / "secret.stl").read_bytes()).hexdigest()),  # no visual shows it
        ("agilex_piper", digest),
        ("meshed", "../meshes/meshed/base_link.stl"),
    ):
        with pytest.raises(NotFound, match="mesh"):
            mesh_content(robot=robot, digest=wanted)


def test_a_mesh_that_has_changed_has_another_address(meshed):
    before = shown()[0]["address"]
    (meshed / "base_link.stl").write_bytes(stl(CORNERS, CORNERS))
    assert shown()[0]["address"] != before
    with pytest.raises(NotFound, match="load the page again"):
        mesh_content(robot="meshed", digest=before.rpartition("/")[2])


def test_a_mesh_that_went_away_is_named_without_its_folder(meshed):
    address = shown()[0]["address"]
    (meshed / "base_link.stl").unlink()
    with pytest.raises(NotFound, match=r"base_link\.stl") as said:
        mesh_content(robot="meshed", digest=address.rpartition("/")[2])
    assert str(meshed) not in str(said.value)


@pytest.mark.django_db
def test_browsers_fetch_it_once_and_after_a_login(client, django_user_model, meshed):
    address = shown()[0]["address"]
    assert client.get(address).status_code == 302
    client.force_login(django_user_model.objects.create_user("ann"))
    answer = client.get(address)
    assert answer.content == (meshed / "base_link.stl").read_bytes()
    assert "immutable" in answer["Cache-Control"]
    assert "private" in answer["Cache-Control"]
    again = client.get(address, headers={"If-None-Match": answer["ETag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert client.post(address).status_code == 405
    for wrong in (
        f"{address[:-1]}{'0' if address[-1] != '0' else '1'}",
        f"{address}/..",
        "/robots/meshed/meshes/x",
    ):
        assert client.get(wrong).status_code == 404
