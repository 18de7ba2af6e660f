from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from robots import shapes, urdf
from robots.draft.mesh_copy import MeshCopyReport, copy_urdf
from tests.robots.draft.urdfs import arm, base, joint, link, single, write

MESH = '<visual><geometry><mesh filename="{}" scale="0.001 0.001 0.001"/></geometry></visual>'


def copied(source: Path, folder: Path) -> tuple[MeshCopyReport, Path]:
    folder.mkdir()
    target = folder / "copy.urdf"
    return copy_urdf(urdf.read(source), target), target


def stl(path: Path, length: float = 100.0) -> Path:
    """A triangle along x."""
    path.parent.mkdir(parents=True, exist_ok=True)
    triangle = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, length, 0, 0, 0, 10, 0, 0)
    path.write_bytes(bytes(80) + struct.pack("<I", 1) + triangle)
    return path


def test_a_urdf_of_simple_shapes_is_copied_to_the_last_byte(tmp_path: Path) -> None:
    source = write(tmp_path, single())
    pictures, target = copied(source, tmp_path / "to")
    assert target.read_bytes() == source.read_bytes()
    assert pictures == MeshCopyReport((), (), (), ())


@pytest.mark.parametrize("named", ["../meshes/link.stl", "package://my_robot/meshes/link.stl", "file://{}"])
def test_meshes_come_along_wherever_the_urdf_says_they_are(tmp_path: Path, named: str) -> None:
    mesh = stl(tmp_path / "my_robot" / "meshes" / "link.stl")
    body = "<!-- kept -->" + link("base_link", MESH.format(named.format(mesh))) + arm("base_link")
    source = write(tmp_path / "my_robot" / "urdf", body)
    pictures, target = copied(source, tmp_path / "to")
    assert (pictures.copied, pictures.missing, pictures.drawn) == (("link.stl",), (), ())
    shape = shapes.read_shapes(target)[0]
    assert shape.file == tmp_path / "to" / "meshes" / "link.stl"
    np.testing.assert_allclose(shape.bounds()[1], [0.1, 0.01, 0], atol=1e-6)
    assert "<!-- kept -->" in target.read_text()
    assert set(urdf.read(target).joints) == set(urdf.read(source).joints)


def test_meshes_of_one_name_in_several_folders_stay_apart(tmp_path: Path) -> None:
    folders = ("a", "b", "x/b", "y/b")
    for number, folder in enumerate(folders, start=1):
        stl(tmp_path / folder / "link.stl", 100.0 * number)
    body = "".join(link(f"l{k}", MESH.format(f"{folder}/link.stl")) for k, folder in enumerate(folders))
    body += "".join(joint(f"j{k}", "l0", f"l{k}") for k in range(1, len(folders)))
    _, target = copied(write(tmp_path, body), tmp_path / "to")
    ends = [float(shape.bounds()[1][0]) for shape in shapes.read_shapes(target)]
    assert ends == pytest.approx([0.1, 0.2, 0.3, 0.4])


@pytest.mark.parametrize("named", ["package://elsewhere/link.stl", "link.glb", "torn.stl"])
def test_cylinders_stand_in_for_meshes_that_are_missing_or_unreadable(tmp_path: Path, named: str) -> None:
    (tmp_path / "link.glb").write_bytes(b"glTF")
    (tmp_path / "torn.stl").write_bytes(b"torn")
    body = base() + arm("base_link").replace(BOX_OF_LINK, MESH.format(named))
    pictures, target = copied(write(tmp_path, body), tmp_path / "to")
    assert (pictures.copied, pictures.missing) == ((), (named,))
    assert pictures.drawn == tuple(f"link{number}" for number in range(1, 7))
    shown = {shape.link: shape for shape in shapes.read_shapes(target)}
    assert [shown["base_link"].kind, shown["link1"].kind, shown["link6"].kind] == [
        "box",
        "cylinder",
        "sphere",
    ]
    length = shown["link1"].size[1]
    assert length == pytest.approx(0.12)
    np.testing.assert_allclose(shown["link1"].origin[:3, 3], [0, 0, 0.06], atol=1e-6)


BOX_OF_LINK = '<visual><origin xyz="0 0 0.05"/><geometry><box size="0.04 0.04 0.08"/></geometry></visual>'


def test_a_stand_in_leads_from_joint_to_joint(tmp_path: Path) -> None:
    body = link("base_link") + link("a") + joint("j", "base_link", "a", xyz="0.1 -0.2 0.2")
    _, target = copied(write(tmp_path, body), tmp_path / "to")
    stick = shapes.read_shapes(target)[0]
    ends = [(stick.origin @ [0, 0, side * stick.size[1] / 2, 1])[:3] for side in (-1, 1)]
    np.testing.assert_allclose(ends, [[0, 0, 0], [0.1, -0.2, 0.2]], atol=1e-5)


def test_no_stand_in_leads_to_a_mere_frame(tmp_path: Path) -> None:
    tool = link("tcp") + joint("to_tcp", "link6", "tcp", kind="fixed", xyz="0 0 0.2")
    body = link("base_link") + arm("base_link", visual=False) + tool
    _, target = copied(write(tmp_path, body), tmp_path / "to")
    assert {shape.link: shape.kind for shape in shapes.read_shapes(target)}["link6"] == "sphere"


def test_a_urdf_that_shows_nothing_is_drawn_in_sticks(tmp_path: Path) -> None:
    pictures, target = copied(
        write(tmp_path, link("base_link") + arm("base_link", visual=False)), tmp_path / "to"
    )
    assert pictures.drawn == ("base_link", *(f"link{number}" for number in range(1, 7)))
    assert {shape.link for shape in shapes.read_shapes(target)} == set(pictures.drawn)


def test_a_material_that_nobody_declares_is_plain(tmp_path: Path) -> None:
    body = base().replace("</visual>", '<material name="chrome"/></visual>') + arm("base_link")
    pictures, target = copied(write(tmp_path, body), tmp_path / "to")
    assert pictures.plain == ("base_link",)
    assert shapes.read_shapes(target)[0].colour == shapes.PLAIN


@pytest.mark.parametrize(
    "shape", ['<box size="0 0.1 0.1"/>', '<sphere radius="0"/>', '<cylinder radius="-1" length="1"/>']
)
def test_a_shape_without_size_is_left_out(tmp_path: Path, shape: str) -> None:
    body = link("base_link", f"<visual><geometry>{shape}</geometry></visual>") + arm("base_link")
    _, target = copied(write(tmp_path, body), tmp_path / "to")
    assert {shown.link for shown in shapes.read_shapes(target)} >= {"link1", "link6"}


@pytest.mark.parametrize("rgba", ["255 0 0 1", "1 1 1", "red", "", "nan 0 0 1"])
def test_a_colour_that_is_none_is_plain(tmp_path: Path, rgba: str) -> None:
    look = '<visual><geometry><sphere radius="0.1"/></geometry><material name="m">{}</material></visual>'
    body = link("base_link", look.format(f'<color rgba="{rgba}"/>')) + arm("base_link")
    pictures, target = copied(
        write(tmp_path, body + f'<material name="n"><color rgba="{rgba}"/></material>'), tmp_path / "to"
    )
    assert shapes.read_shapes(target)[0].colour == shapes.PLAIN
    assert pictures.plain == ("base_link",)
