"""MuJoCo model of a bench: a robot's arms, a table, discs and blocks.

Nothing but contact forces acts between a block and a gripper. The two fingers of a gripper are coupled, as by its rack
and pinion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.simulation.bench.bench import Bench
from runtime.simulation.contact import physics as numbers
from runtime.simulation.contact.arms import ArmBuilder, DrivenJoints
from runtime.simulation.contact.geoms import Geoms, import_mujoco
from runtime.simulation.contact.physics import Physics
from runtime.simulation.contact.solids import Solid

if TYPE_CHECKING:
    from robots import Robot


@dataclass(frozen=True, slots=True, eq=False)
class ContactModel:
    """Compiled model, with the places of its parts in MuJoCo's arrays.

    `blocks` are the indices of the first of the seven position numbers of each block. `block_geoms` maps shapes to the
    numbers of blocks, `finger_geoms` to an arm and a side. `discs` are the numbers of the discs among the movable fixed
    bodies.
    """

    model: Any
    joints: DrivenJoints
    blocks: tuple[int, ...]
    block_geoms: dict[int, int]
    finger_geoms: dict[int, tuple[str, int]]
    discs: tuple[int, ...]


def build_model(robot: Robot, bench: Bench, blocks: int, physics: Physics) -> ContactModel:
    """Return the model of a robot at a bench with so many blocks.

    Raises:
        SetupError: If MuJoCo is not installed.
    """
    mujoco = import_mujoco()
    spec = _new_spec(mujoco)
    _add_objects(spec, Geoms(mujoco), bench, blocks, physics)
    arms = ArmBuilder(robot, physics, mujoco, spec)
    arms.add()
    model = spec.compile()
    names = [f"block {index}" for index in range(blocks)]
    return ContactModel(
        model,
        arms.set_drives(model),
        tuple(int(model.joint(name).qposadr[0]) for name in names),
        {int(model.geom(name).id): index for index, name in enumerate(names)},
        {int(model.geom(name).id): finger for name, finger in arms.fingers.items()},
        tuple(int(model.body(_disc_name(index)).mocapid[0]) for index in range(len(bench.discs))),
    )


def _new_spec(mujoco: Any) -> Any:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.boundmass, spec.compiler.boundinertia = numbers.LEAST_MASS, numbers.LEAST_INERTIA
    spec.compiler.balanceinertia = (
        True  # published inertias are often rounded so that they are not quite physical
    )
    spec.option.timestep = numbers.STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = numbers.IMPRATIO
    return spec


def _add_objects(spec: Any, geoms: Geoms, bench: Bench, blocks: int, physics: Physics) -> None:
    world = spec.worldbody
    geoms.add_plane(world, physics.table_friction)
    for index, disc in enumerate(bench.discs):
        middle = np.eye(4)
        middle[2, 3] = disc.height / 2
        solid = Solid("cylinder", (disc.radius, disc.height), middle)
        geoms.add_solid(world.add_body(name=_disc_name(index), mocap=True), solid, physics.plate_friction)
    for index in range(blocks):
        body = world.add_body(name=f"block {index}")
        body.add_freejoint(name=f"block {index}")
        edge = bench.edge(index)
        geom = geoms.add_block(body, edge, physics.block_friction)
        geom.name, geom.mass = f"block {index}", physics.block_mass * (edge / numbers.BLOCK_EDGE) ** 3


def _disc_name(index: int) -> str:
    return f"disc {index}"
