"""Factors of a position: what they change, what is refused, and that the next reset is as usual again."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from runtime.benches.schema import load_schema
from runtime.simulation.bench.bench import Bench, BenchError
from runtime.simulation.bench.block_table import ResetRequest
from runtime.simulation.bench.conveyor import Conveyor
from runtime.simulation.bench.tabletop import Tabletop
from runtime.simulation.contact.bench import ContactTabletop
from runtime.simulation.render import Renderer
from tests.runtime.simulation.bench_trial import ROBOT

HOME = ROBOT.poses["home"]


def lay(table: Any, identity: str, **factors: float) -> Any:
    table.reset(ResetRequest(identity, 3, None, factors))
    return table


@pytest.fixture(scope="module")
def table() -> ContactTabletop:
    return ContactTabletop(ROBOT, 0)


def test_light_and_camera_change_the_pictures_alone(table: ContactTabletop) -> None:
    renderer = Renderer(ROBOT, Bench(), 160, 120)
    usual = renderer.draw(HOME, lay(table, "a").state())["cam_high"].astype(int)
    dim = renderer.draw(HOME, lay(table, "b", light=0.5).state())["cam_high"].astype(int)
    assert np.abs(dim - usual // 2).max() <= 1
    moved = lay(table, "c", camera_x=0.05)
    assert np.abs(renderer.draw(HOME, moved.state())["cam_high"].astype(int) - usual).mean() > 3
    assert moved.truth()["factors"] == {"camera_x": 0.05}
    again = lay(table, "d")
    assert (renderer.draw(HOME, again.state())["cam_high"] == usual).all()
    assert "factors" not in again.truth()


def test_masses_and_friction_are_multiplied_and_come_back(table: ContactTabletop) -> None:
    model, (geom,) = lay(table, "e")._model, lay(table, "e")._built.block_geoms
    body = model.geom_bodyid[geom]
    mass, inertia = float(model.body_mass[body]), model.body_inertia[body].copy()
    friction = model.geom_friction[:, 0].copy()
    lay(table, "f", mass=3.0, friction=0.5)
    assert model.body_mass[body] == pytest.approx(3 * mass)
    np.testing.assert_allclose(model.body_inertia[body], 3 * inertia)
    np.testing.assert_allclose(model.geom_friction[:, 0], friction / 2)
    lay(table, "g", friction=1.25)
    assert model.geom_friction[:, 0].max() <= 1.0
    lay(table, "h")
    assert model.body_mass[body] == pytest.approx(mass)
    np.testing.assert_allclose(model.geom_friction[:, 0], friction)


def test_size_and_hue_change_body_and_picture_of_the_block_and_come_back(table: ContactTabletop) -> None:
    renderer = Renderer(ROBOT, Bench(), 160, 120)

    def seen(identity: str, **factors: float) -> tuple[float, float, Any]:
        state = lay(table, identity, **factors).state()
        geom, *_ = table._built.block_geoms
        mass = table._model.body_mass[table._model.geom_bodyid[geom]]
        return 2 * table._model.geom_size[geom, 0], mass, renderer.draw(HOME, state)["cam_high"]

    edge, mass, usual = seen("s1")
    larger = seen("s2", size=1.4)
    assert larger[0] == pytest.approx(1.4 * edge)
    assert larger[1] == pytest.approx(1.4**3 * mass)
    assert table.truth()["edges"] == [pytest.approx(1.4 * edge)]
    assert table._blocks[0].bottom == pytest.approx(0.0, abs=1e-6)
    green = seen("s3", hue=120, distractors=1)
    assert table.truth()["colours"] == [[22, 226, 74], [40, 150, 70]]
    for _, _, picture in (larger, green):
        assert np.abs(picture.astype(int) - usual).max() > 50
    back = seen("s4")
    assert back[:2] == (edge, mass)
    assert (back[2] == usual).all()
    assert not {"edges", "colours"} & table.truth().keys()


def test_distractors_come_and_go(table: ContactTabletop) -> None:
    joints = lay(table, "i")._data.qpos[table._joints.positions].copy()
    assert len(lay(table, "j", distractors=3).state().blocks) == 4
    np.testing.assert_allclose(table._data.qpos[table._joints.positions], joints)
    assert len(lay(table, "k").state().blocks) == 1


@pytest.mark.parametrize(
    ("factors", "why"),
    [
        ({"light": 5.0}, "factors.light = 5.0; allowed: a number from 0.3 to 1.5"),
        ({"light": "dim"}, "factors.light = 'dim'"),
        ({"light": float("nan")}, "factors.light = nan"),
        ({"distractors": 1.5}, "factors.distractors = 1.5; allowed: a whole number from 0 to 4"),
        ({"colour": 1.0}, "factors.colour: unknown factor; allowed: light, friction, mass, size, hue"),
    ],
)
def test_what_the_bench_does_not_have_is_refused_and_changes_nothing(
    table: ContactTabletop, factors: dict[str, Any], why: str
) -> None:
    lay(table, "before", light=0.7)
    with pytest.raises(BenchError, match=re.escape(why)):
        lay(table, "refused", **factors)
    assert (table.truth()["reset"], table.state().light) == ("before", 0.7)


def test_benches_without_forces_refuse_what_they_cannot_simulate() -> None:
    plain = Tabletop(ROBOT, 0)
    assert lay(plain, "a", light=0.5).state().light == 0.5
    with pytest.raises(BenchError, match=r"factors\.mass: allowed on benches with contact forces"):
        lay(plain, "b", mass=2.0)
    with pytest.raises(BenchError, match="on a conveyor: none"):
        lay(Conveyor(ROBOT, 0), "c", light=0.5)


def test_every_factor_of_every_bench_has_its_usual_value_within_its_bounds() -> None:
    for name in ("tabletop", "sorting"):
        schema = load_schema(name)
        usual = schema.factor_values({})
        assert list(schema.factor_problems(usual)) == []
        assert set(usual) == set(schema.factors)
