from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from robots import RobotError, urdf

LINKS = '<link name="a"/><link name="b"/>'
JOINT = '<joint name="j" type="{kind}"><parent link="a"/><child link="b"/>{rest}</joint>'

MIMIC = '<mimic joint="{0}" multiplier="{1}" offset="{2}"/>'


def write(folder: Path, body: str, tag: str = "robot") -> Path:
    path = folder / "thing.urdf"
    path.write_text(f'<{tag} name="thing">{body}</{tag}>')
    return path


def test_defaults_are_those_of_the_format(tmp_path: Path) -> None:
    tree = urdf.read(write(tmp_path, LINKS + JOINT.format(kind="continuous", rest="")))
    joint = tree.joint("j")
    assert tree.root == "a"
    np.testing.assert_array_equal(joint.axis, [1, 0, 0])
    np.testing.assert_array_equal(joint.origin, np.eye(4))
    assert (joint.lower, joint.upper, joint.velocity, joint.mimic) == (-math.inf, math.inf, None, None)


def test_everything_declared_is_read_at_full_precision(tmp_path: Path) -> None:
    rest = (
        '<origin xyz="0.1234567890123 2 3" rpy="0 0 0.5"/><axis xyz="0 3 4"/>'
        '<limit lower="-1.5" upper="2.5" velocity="3.5"/><mimic joint="k" multiplier="-2" offset="0.25"/>'
    )
    body = LINKS + '<link name="c"/>' + JOINT.format(kind="revolute", rest=rest)
    body += '<joint name="k" type="prismatic"><parent link="b"/><child link="c"/></joint>'
    joint = urdf.read(write(tmp_path, body)).joint("j")
    assert joint.origin[0, 3] == 0.1234567890123
    assert joint.origin[1, 0] == math.sin(0.5)
    np.testing.assert_allclose(joint.axis, [0, 0.6, 0.8])
    assert (joint.lower, joint.upper, joint.velocity) == (-1.5, 2.5, 3.5)
    assert joint.mimic == urdf.Mimic("k", -2.0, 0.25)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("", "links without a parent are []"),
        (LINKS, "links without a parent are ['a', 'b']"),
        (LINKS + JOINT.format(kind="spherical", rest=""), "type 'spherical'; allowed: fixed, revolute"),
        (LINKS + JOINT.format(kind="revolute", rest='<axis xyz="0 0 0"/>'), "axis xyz is '0 0 0'"),
        (LINKS + JOINT.format(kind="revolute", rest='<axis xyz="0 0"/>'), "allowed: 3 finite number"),
        (LINKS + JOINT.format(kind="revolute", rest='<origin xyz="0 x 0"/>'), "origin xyz is '0 x 0'"),
        (LINKS + JOINT.format(kind="revolute", rest='<limit lower="nan"/>'), "limit lower is 'nan'"),
        (
            LINKS + JOINT.format(kind="revolute", rest='<mimic joint="z"/>'),
            "mimics 'z', which is not declared",
        ),
        (
            LINKS
            + JOINT.format(kind="fixed", rest="")
            + '<link name="c"/><joint name="c" type="fixed"><parent link="c"/><child link="c"/></joint>',
            "the links ['c'] hang on each other in a circle, and not on 'a'",
        ),
        ('<link name="a"/>' + JOINT.format(kind="fixed", rest=""), "names link 'b', which is not declared"),
        (LINKS + JOINT.format(kind="fixed", rest="") * 2, "joint j declared more than once"),
        (LINKS + '<joint name="j" type="fixed"><child link="b"/></joint>', "'j' names no parent link"),
        (LINKS + '<joint type="fixed"/>', "a <joint> has no 'name'"),
        (LINKS + '<link name="a"/>' + JOINT.format(kind="fixed", rest=""), "link a declared more than once"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, body: str, said: str) -> None:
    path = write(tmp_path, body)
    with pytest.raises(RobotError) as error:
        urdf.read(path)
    assert said in str(error.value)
    assert str(path) in str(error.value)


def test_a_file_that_is_no_urdf_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="cannot be read as URDF"):
        urdf.read(tmp_path / "absent.urdf")
    (tmp_path / "torn.urdf").write_text("<robot><link")
    with pytest.raises(RobotError, match="cannot be read as URDF"):
        urdf.read(tmp_path / "torn.urdf")
    with pytest.raises(RobotError, match="outermost element is <sdf>"):
        urdf.read(write(tmp_path, LINKS, tag="sdf"))


def test_a_joint_or_link_that_is_not_there_is_answered_with_those_that_are(tmp_path: Path) -> None:
    tree = urdf.read(write(tmp_path, LINKS + JOINT.format(kind="fixed", rest="")))
    with pytest.raises(RobotError, match="no joint 'wrist'; it has j"):
        tree.joint("wrist")
    with pytest.raises(RobotError, match="no link 'hand'; it has a, b"):
        tree.between("a", "hand")
    with pytest.raises(RobotError, match="'a' does not hang on link 'b'"):
        tree.between("b", "a")


@pytest.mark.parametrize(
    "body",
    [
        LINKS
        + '<joint name="j" type="fixed"><parent link="a"/><child link="b"/><origin xyz="0 0 ${height}"/></joint>',
        '<xacro:include xmlns:xacro="http://www.ros.org/wiki/xacro" filename="arm.xacro"/>' + LINKS,
        LINKS + '<joint name="$(arg prefix)j" type="fixed"><parent link="a"/><child link="b"/></joint>',
    ],
)
def test_a_xacro_is_refused_with_what_makes_a_urdf_of_it(tmp_path: Path, body: str) -> None:
    with pytest.raises(RobotError, match=r"this is a xacro.*: xacro thing\.urdf > thing\.urdf"):
        urdf.read(write(tmp_path, body))


def test_a_urdf_that_was_made_of_a_xacro_is_one(tmp_path: Path) -> None:
    path = tmp_path / "thing.urdf"
    path.write_text(
        f'<robot name="thing" xmlns:xacro="http://www.ros.org/wiki/xacro">{LINKS}'
        f"{JOINT.format(kind='fixed', rest='')}</robot>"
    )
    assert urdf.read(path).root == "a"


def test_a_mimic_is_traced_to_the_joint_that_moves_by_itself(tmp_path: Path) -> None:
    joint = '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>{3}</joint>'
    body = "".join(f'<link name="{name}"/>' for name in "abcd")
    body += joint.format("first", "c", "d", "") + joint.format(
        "second", "a", "b", MIMIC.format("first", 2, 0.5)
    )
    body += joint.format("third", "b", "c", MIMIC.format("second", -3, 0.1))
    tree = urdf.read(write(tmp_path, body))
    master, factor, offset = tree.master(tree.joint("third"))
    assert (master.name, factor) == ("first", -6.0)
    assert offset == pytest.approx(0.1 - 3 * 0.5)
    assert tree.master(tree.joint("first"))[1:] == (1.0, 0.0)
    assert [joint.name for joint in tree.outwards()] == ["second", "third", "first"]


def test_mimics_in_a_circle_are_refused(tmp_path: Path) -> None:
    joint = '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>{3}</joint>'
    body = '<link name="a"/><link name="b"/><link name="c"/>' + joint.format(
        "x", "a", "b", MIMIC.format("y", 1, 0)
    )
    tree = urdf.read(write(tmp_path, body + joint.format("y", "b", "c", MIMIC.format("x", 1, 0))))
    with pytest.raises(RobotError, match="joints x, y mimic each other in a circle"):
        tree.master(tree.joint("x"))


@pytest.mark.parametrize("axis", ["0 0 0", "", "0 0"])
def test_the_axis_of_a_fixed_joint_does_not_matter(tmp_path: Path, axis: str) -> None:
    read = urdf.read(write(tmp_path, LINKS + JOINT.format(kind="fixed", rest=f'<axis xyz="{axis}"/>')))
    assert read.joint("j").kind == "fixed"


def test_limits_of_an_endless_joint_do_not_matter(tmp_path: Path) -> None:
    rest = '<limit lower="-inf" upper="inf" velocity="2"/>'
    joint = urdf.read(write(tmp_path, LINKS + JOINT.format(kind="continuous", rest=rest))).joint("j")
    assert (joint.lower, joint.upper, joint.velocity) == (-math.inf, math.inf, 2.0)


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_joints_that_nothing_drives_are_held_where_they_are_drawn(tmp_path: Path, kind: str) -> None:
    read = urdf.read(write(tmp_path, LINKS + JOINT.format(kind=kind, rest="")))
    assert (read.joint("j").kind, read.held) == ("fixed", ("j",))


@pytest.mark.parametrize("kind", ["fixed", "floating", "planar"])
def test_limits_of_joints_that_do_not_move_do_not_matter(tmp_path: Path, kind: str) -> None:
    limit = '<limit lower="-inf" upper="inf" velocity="-"/>'
    read = urdf.read(write(tmp_path, LINKS + JOINT.format(kind=kind, rest=limit))).joint("j")
    assert (read.kind, read.lower, read.upper, read.velocity) == ("fixed", None, None, None)


def test_a_byte_order_mark_says_more_than_the_declaration(tmp_path: Path) -> None:
    body = '<?xml version="1.0" encoding="gb2312"?><robot name="r"><link name="\u4e2d"/></robot>'
    (tmp_path / "r.urdf").write_bytes(body.encode("utf-8-sig"))
    assert urdf.read(tmp_path / "r.urdf").root == "\u4e2d"


@pytest.mark.parametrize("encoding", ["gb2312", "GBK", "shift_jis", "utf-8", "iso-8859-1", "UTF-16"])
def test_any_encoding_that_python_knows_is_read(tmp_path: Path, encoding: str) -> None:
    comment = "\u00e9" if encoding == "iso-8859-1" else "\u4e2d"
    body = f'<?xml version="1.0" encoding="{encoding}"?><!-- {comment} --><robot name="r"><link name="a"/></robot>'
    (tmp_path / "r.urdf").write_bytes(body.encode(encoding))
    assert urdf.read(tmp_path / "r.urdf").root == "a"


@pytest.mark.parametrize(
    ("encoding", "content", "said"),
    [
        ("klingon", b"", "encoding 'klingon' is not known"),
        ("ascii", "\u00e9".encode(), "cannot be read as URDF"),
        ("base64", b"", "cannot be read as URDF"),
    ],
)
def test_an_encoding_that_is_none_is_named(tmp_path: Path, encoding: str, content: bytes, said: str) -> None:
    head = f'<?xml version="1.0" encoding="{encoding}"?><robot name="r">'.encode()
    (tmp_path / "r.urdf").write_bytes(head + content + b'<link name="a"/></robot>')
    with pytest.raises(RobotError, match=said):
        urdf.read(tmp_path / "r.urdf")
