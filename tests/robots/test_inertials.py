import numpy as np
import pytest

from robots.errors import RobotError
from robots.inertials import Inertial, combine, read_inertials

URDF = '<robot name="r"><link name="a">{}</link><link name="b"/></robot>'
TENSOR = '<inertia ixx="1" ixy="0" ixz="0" iyy="2" iyz="0" izz="3"/>'


def read(tmp_path, inertial):
    path = tmp_path / "r.urdf"
    path.write_text(URDF.format(inertial))
    return read_inertials(path)


def box(x, y, z, mass=1.0):
    return Inertial(mass, np.zeros(3), mass / 12 * np.diag([y**2 + z**2, x**2 + z**2, x**2 + y**2]))


def test_an_inertial_is_read_in_the_axes_of_its_link(tmp_path):
    quarter = '<origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/>'
    found = read(tmp_path, f'<inertial>{quarter}<mass value="5"/>{TENSOR}</inertial>')
    assert list(found) == ["a"]
    assert found["a"].mass == 5.0
    np.testing.assert_allclose(found["a"].centre, [0, 0, 1])
    np.testing.assert_allclose(found["a"].inertia, np.diag([2, 1, 3]), atol=1e-12)


def test_a_mass_of_zero_is_none(tmp_path):
    assert read(tmp_path, f'<inertial><mass value="0"/>{TENSOR}</inertial>') == {}


@pytest.mark.parametrize(
    ("inertial", "says"),
    [
        (TENSOR, "no 'value' in <mass>"),
        ('<mass value="1"/>', "no 'ixx' in <inertia>"),
        (f'<mass value="x"/>{TENSOR}', "mass value is 'x'"),
        (f'<mass value="-1"/>{TENSOR}', "negative mass"),
        ('<mass value="1"/>' + TENSOR.replace('ixx="1"', 'ixx="-1"'), "negative mass or principal inertia"),
    ],
)
def test_what_cannot_be_is_refused_with_the_name_of_the_link(inertial, says, tmp_path):
    with pytest.raises(RobotError, match="r.urdf: link 'a'.*" + says):
        read(tmp_path, f"<inertial>{inertial}</inertial>")


def test_two_halves_make_the_whole():
    whole, half = box(0.4, 0.2, 0.1, 2.0), box(0.2, 0.2, 0.1)
    left, right, turned = np.eye(4), np.eye(4), box(0.2, 0.2, 0.1)
    left[0, 3], right[0, 3] = -0.1, 0.1
    right[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    both = combine([(left, half), (right, turned)])
    assert both.mass == 2.0
    np.testing.assert_allclose(both.centre, 0.0, atol=1e-12)
    np.testing.assert_allclose(both.inertia, whole.inertia, atol=1e-12)
