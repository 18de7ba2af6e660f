from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robots import RobotError, load_robot, robot_names, shapes

VISUAL = '<link name="a"><visual>{body}</visual></link>'
BOX = '<geometry><box size="1 2 3"/></geometry>'


def write(folder: Path, body: str) -> Path:
    path = folder / "thing.urdf"
    path.write_text(f'<robot name="thing">{body}</robot>')
    return path


def test_every_kind_is_read_with_size_origin_and_colour(tmp_path: Path) -> None:
    body = '<material name="red"><color rgba="1 0 0 0.5"/></material><link name="a">'
    body += f'<visual><origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>{BOX}<material name="red"/></visual>'
    body += '<visual><geometry><cylinder radius="0.1" length="0.4"/></geometry></visual></link>'
    body += '<link name="b"><visual><geometry><sphere radius="0.2"/></geometry>'
    body += '<material name=""><color rgba="0 1 0 1"/></material></visual></link>'
    box, cylinder, sphere = shapes.read_shapes(write(tmp_path, body))
    assert (box.link, box.kind, box.size, box.colour) == ("a", "box", (1, 2, 3), (1, 0, 0, 0.5))
    np.testing.assert_allclose(
        box.origin, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12
    )
    assert (cylinder.kind, cylinder.size, cylinder.colour) == ("cylinder", (0.1, 0.4), shapes.PLAIN)
    assert (sphere.link, sphere.kind, sphere.size, sphere.colour) == ("b", "sphere", (0.2,), (0, 1, 0, 1))


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("", "link 'a': a visual shows nothing; allowed: one of box, cylinder, sphere, mesh"),
        ('<geometry><capsule radius="1"/></geometry>', "link 'a': a visual shows <capsule>; allowed: one of"),
        ('<geometry><box size="1 2"/></geometry>', "link 'a': box size is '1 2'; allowed: 3 finite number"),
        ('<geometry><cylinder radius="1"/></geometry>', "a <cylinder> has no 'length'"),
        ('<geometry><sphere radius="0"/></geometry>', "link 'a': sphere 0; allowed: lengths above zero"),
        (BOX + '<material name="green"/>', "material 'green' is not declared; allowed: none is declared"),
        (
            BOX + '<material name="g"><color rgba="0 2 0 1"/></material>',
            "(0.0, 2.0, 0.0, 1.0); allowed: 0 to 1",
        ),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, body: str, said: str) -> None:
    path = write(tmp_path, VISUAL.format(body=body))
    with pytest.raises(RobotError) as error:
        shapes.read_shapes(path)
    assert said in str(error.value)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("body", "half"),
    [
        (BOX, (0.5, 1, 1.5)),
        ('<geometry><cylinder radius="0.1" length="0.4"/></geometry>', (0.1, 0.1, 0.2)),
        ('<geometry><sphere radius="0.2"/></geometry>', (0.2, 0.2, 0.2)),
    ],
)
def test_bounds_are_around_the_shape_in_its_own_frame(
    tmp_path: Path, body: str, half: tuple[float, ...]
) -> None:
    origin = '<origin xyz="1 2 3" rpy="1 0 0"/>'
    (shape,) = shapes.read_shapes(write(tmp_path, VISUAL.format(body=origin + body)))
    lower, upper = shape.bounds()
    np.testing.assert_allclose(lower, np.negative(half))
    np.testing.assert_allclose(upper, half)


@pytest.mark.parametrize("name", robot_names())
def test_every_robot_can_be_seen(name: str) -> None:
    assert len(shapes.read_shapes(load_robot(name).urdf)) > 0
