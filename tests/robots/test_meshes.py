"""Files with meshes: found where a URDF or the environment says, nowhere else, and measured."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from robots import RobotError, meshes, shapes
from robots.visuals import Visual

CORNERS = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.2, -0.3)]
OBJ = "# a triangle\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "vn 9 9 9\nf 1 2 3\n"
STL = "solid one\n facet normal 0 0 1\n  outer loop\n"
STL += "".join(f"   vertex {x} {y} {z}\n" for x, y, z in CORNERS) + "  endloop\n endfacet\nendsolid\n"
DAE = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.001"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="9">0 0 0 100 0 0 0 200 -300</float_array></source>
<source id="n"><float_array id="b" count="3">900 900 900</float_array></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices></mesh></geometry></library_geometries>
<library_nodes><node id="kept"><translate>0 0 1000</translate><instance_geometry url="#g"/></node></library_nodes>
<library_visual_scenes><visual_scene id="s"><node><matrix>1 0 0 50 0 1 0 0 0 0 1 0 0 0 0 1</matrix>
<node><rotate>0 0 1 90</rotate><scale>2 1 1</scale><instance_geometry url="#g"/></node></node>
<node><instance_node url="#kept"/></node></visual_scene></library_visual_scenes></COLLADA>"""


def binary(corners: list[tuple[float, float, float]]) -> bytes:
    triangle = struct.pack("<12fH", 0, 0, 1, *(number for corner in corners for number in corner), 0)
    return b"solid which is binary all the same".ljust(80) + struct.pack("<I", 1) + triangle


def robot(folder: Path, visual: str, link: str = "a") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "thing.urdf"
    path.write_text(f'<robot name="thing"><link name="{link}">{visual}</link></robot>')
    return path


def mesh(filename: str, scale: str = "") -> str:
    return f'<visual><geometry><mesh filename="{filename}"{scale}/></geometry></visual>'


@pytest.fixture(autouse=True)
def no_other_meshes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(meshes.ENVIRONMENT, raising=False)


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.stl", STL.encode()), ("b.STL", binary(CORNERS)), ("c.obj", OBJ.encode())],
)
def test_the_box_around_a_mesh_is_read_from_its_file(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    lower, upper = meshes.mesh_bounds(tmp_path / name)
    np.testing.assert_allclose(lower, [0, 0, -0.3], atol=1e-7)
    np.testing.assert_allclose(upper, [0.1, 0.2, 0], atol=1e-7)


def test_the_box_around_a_collada_follows_its_scene_and_its_unit(tmp_path: Path) -> None:
    (tmp_path / "a.dae").write_text(DAE)
    lower, upper = meshes.mesh_bounds(tmp_path / "a.dae")
    np.testing.assert_allclose(lower, [0.05 - 0.2, 0, -0.3], atol=1e-12)
    np.testing.assert_allclose(upper, [0.1, 0.2, 1.0], atol=1e-12)


def test_a_collada_is_read_in_any_encoding(tmp_path: Path) -> None:
    text = DAE.replace('<?xml version="1.0"?>', '<?xml version="1.0" encoding="GBK"?>').replace(
        'id="kept"', 'id="手"'
    )
    (tmp_path / "a.dae").write_bytes(text.replace("#kept", "#手").encode("gbk"))
    assert meshes.mesh_bounds(tmp_path / "a.dae")[1].tolist() == pytest.approx([0.1, 0.2, 1.0])


def test_a_changed_file_is_read_again(tmp_path: Path) -> None:
    file = tmp_path / "a.obj"
    file.write_text("v 0 0 0\nv 1 1 1\n")
    assert meshes.mesh_bounds(file)[1].tolist() == [1, 1, 1]
    file.write_text("v 0 0 0\nv 2 2 2\n")
    os.utime(file, ns=(1, 1))
    assert meshes.mesh_bounds(file)[1].tolist() == [2, 2, 2]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.stl", b"\x00" * 100),
        ("a.stl", b"solid empty\nendsolid\n"),
        ("a.obj", b"v nan 0 0\n"),
        ("a.obj", b"v one two three\n"),
        ("a.dae", b"<COLLADA>"),
        ("a.dae", b"<COLLADA/>"),
    ],
)
def test_what_is_no_mesh_is_refused_by_name(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RobotError, match=f"{name}: cannot be read as a mesh"):
        meshes.mesh_bounds(tmp_path / name)


@pytest.mark.parametrize(("name", "content"), [("a.obj", OBJ), ("a.stl", STL)])
def test_empty_lines_cost_nothing(tmp_path: Path, name: str, content: str) -> None:
    """300,000 of them would take hours if the space before a word could be theirs."""
    first, rest = content.split("\n", 1)
    (tmp_path / name).write_text(first + 300_000 * "\n" + rest)
    assert meshes.mesh_bounds(tmp_path / name)[0].tolist() == pytest.approx([0, 0, -0.3])


def test_a_collada_that_shows_one_mesh_a_billion_times_is_refused(tmp_path: Path) -> None:
    nodes = "".join(
        f'<node id="n{k}">{2 * f"""<instance_node url="#n{k + 1}"/>"""}</node>' for k in range(30)
    )
    (tmp_path / "a.dae").write_text(
        DAE.replace('<node id="kept">', f'{nodes}<node id="kept">').replace("#kept", "#n0")
    )
    with pytest.raises(RobotError, match="more than 20000 nodes"):
        meshes.mesh_bounds(tmp_path / "a.dae")


@pytest.mark.parametrize(
    ("filename", "place"),
    [
        ("m.obj", "m.obj"),
        ("meshes/m.obj", "meshes/m.obj"),
        ("package://arm_description/meshes/m.obj", "arm_description/meshes/m.obj"),
        ("package://arm_description/meshes/m.obj", "meshes/m.obj"),
        ("file://{folder}/meshes/m.obj", "meshes/m.obj"),
    ],
)
@pytest.mark.parametrize("root", ["thing", "library/thing"])
def test_a_mesh_is_found_in_the_robots_folder_or_in_that_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, filename: str, place: str, root: str
) -> None:
    monkeypatch.setenv(meshes.ENVIRONMENT, str(tmp_path / "library"))
    file = tmp_path / root / place
    file.parent.mkdir(parents=True)
    (tmp_path / "library").mkdir(exist_ok=True)
    file.write_text(OBJ)
    path = robot(tmp_path / "thing", mesh(filename.format(folder=tmp_path / root), ' scale="2 1 -1"'))
    (shape,) = shapes.read_shapes(path)
    assert (shape.kind, shape.size, shape.file) == ("mesh", (2, 1, -1), file)
    lower, upper = shape.bounds()
    np.testing.assert_allclose((lower, upper), [[0, 0, 0], [0.2, 0.2, 0.3]], atol=1e-12)


@pytest.mark.parametrize(
    "filename",
    [
        "../other/a.obj",
        "package://../other/a.obj",
        "package://x/../../other/a.obj",
        "file://{folder}/other/a.obj",
        "file://{folder}/thing/%2e%2e/other/a.obj",
        "link.obj",
    ],
)
def test_a_mesh_elsewhere_is_refused_even_where_it_exists(tmp_path: Path, filename: str) -> None:
    other = tmp_path / "other/a.obj"
    other.parent.mkdir()
    other.write_text(OBJ)
    path = robot(tmp_path / "thing", mesh(filename.format(folder=tmp_path)))
    (tmp_path / "thing/link.obj").symlink_to(other)
    with pytest.raises(RobotError, match=f"link 'a': mesh .* allowed: files in {tmp_path / 'thing'}"):
        shapes.read_shapes(path)


@pytest.mark.parametrize(
    ("visual", "said"),
    [
        (mesh("a.stl"), "link 'a': mesh 'a.stl' is missing; looked for {folder}/a.stl; put it there"),
        (mesh("a.glb"), "link 'a': mesh 'a.glb'; allowed: files .stl, .obj, .dae"),
        (mesh(300 * "a" + ".stl"), "is no name of a file"),
        (mesh("http://there/a.stl"), "allowed: a path, package://... or file://..."),
        (mesh("a.stl", ' scale="1 0 1"'), "mesh scale 1 0 1; allowed: factors other than zero"),
        ("<visual><geometry><mesh/></geometry></visual>", "a <mesh> has no 'filename'"),
    ],
)
def test_what_is_wrong_with_a_mesh_is_named(tmp_path: Path, visual: str, said: str) -> None:
    with pytest.raises(RobotError) as error:
        shapes.read_shapes(robot(tmp_path / "thing", visual))
    assert said.format(folder=tmp_path / "thing") in str(error.value)


def test_a_folder_of_meshes_that_is_not_there_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(meshes.ENVIRONMENT, str(tmp_path / "gone"))
    with pytest.raises(RobotError, match=r"EVA_ROBOT_MESHES = '.*gone' is no folder"):
        shapes.displayed_shapes(robot(tmp_path / "thing", mesh("a.stl")))


BOX = '<visual><origin xyz="1 0 0"/><geometry><box size="1 1 1"/></geometry>{material}</visual>'
RED = '<material name="red"><color rgba="1 0 0 1"/></material>'


def test_a_mesh_of_a_links_name_is_shown_instead_of_its_shapes_and_never_collides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = robot(tmp_path / "thing", BOX.format(material=RED) * 2)
    file = tmp_path / "library/thing/a.obj"
    file.parent.mkdir(parents=True)
    file.write_text(OBJ)
    monkeypatch.setenv(meshes.ENVIRONMENT, str(tmp_path / "library"))
    (shape,) = shapes.displayed_shapes(path)
    assert (shape.link, shape.kind, shape.size, shape.file) == ("a", "mesh", (1, 1, 1), file)
    assert shape.colour == (1, 0, 0, 1)
    np.testing.assert_array_equal(shape.origin, np.eye(4))
    assert [shape.kind for shape in shapes.read_shapes(path)] == [
        "box",
        "box",
    ]  # what collides is the description's


def test_a_mesh_of_a_links_name_stands_for_one_that_the_urdf_names_and_that_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = robot(tmp_path / "thing", mesh("package://gone/a.dae"))
    file = tmp_path / "library/thing/a.stl"
    file.parent.mkdir(parents=True)
    file.write_text(STL)
    monkeypatch.setenv(meshes.ENVIRONMENT, str(tmp_path / "library"))
    assert [shape.file for shape in shapes.read_shapes(path)] == [file]


def test_a_link_name_leads_to_no_file_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = robot(tmp_path / "thing", BOX.format(material=""), link="../secret")
    (tmp_path / "library/thing").mkdir(parents=True)
    (tmp_path / "library/secret.obj").write_text(OBJ)
    monkeypatch.setenv(meshes.ENVIRONMENT, str(tmp_path / "library"))
    assert [shape.kind for shape in shapes.displayed_shapes(path)] == ["box"]


def test_those_who_can_draw_no_mesh_draw_the_box_around_it(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(OBJ)
    origin = np.eye(4)
    origin[:3, 3] = 1, 2, 3
    box = Visual(0, "mesh", (1, 1, 2), origin, (1, 0, 0, 1), tmp_path / "a.obj").simple()
    assert (box.kind, box.file) == ("box", None)
    np.testing.assert_allclose(box.size, [0.1, 0.2, 0.6])
    np.testing.assert_allclose(box.origin[:3, 3], [1.05, 2.1, 2.7])
    assert box.simple() is box
