"""Simulated tabletop with contact physics: friction alone holds a block between the jaws.

Drives move the arms: each joint's reference follows its target as on the bench without contact forces, and a position
controller with limited effort moves the joint along its reference. Forces can stop joints; a reference is then at most
a little ahead of its joint. The plant's joints are the measured ones, so that a held block stops the jaws.

The simulation is deterministic: the same commands at the same times after the same reset have the same result, on
machines of one kind.
"""

from __future__ import annotations

import logging
import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from runtime.core.types import Float64
from runtime.simulation.bench.bench import Bench
from runtime.simulation.bench.block_table import BlockTable, ResetRequest
from runtime.simulation.bench.plant import Plant
from runtime.simulation.contact.geoms import import_mujoco
from runtime.simulation.contact.model import ContactModel, build_model
from runtime.simulation.contact.physics import PLANT_STEP, STEP, Physics

if TYPE_CHECKING:
    from robots import Robot

log = logging.getLogger(__name__)
_SUBSTEPS = round(PLANT_STEP / STEP)
_LONGEST_NOTE = 1 / 30  # [s] longest time between two updates of milestones
# Solvers leave motions of nanometres. Changes below these bounds are not shown, so that images need not be drawn again.
_SHOWN_M = 5e-7  # [m, or part of a unit axis]
_SHOWN_RAD = 1e-7  # [rad, or unit of a gripper]


class ContactTabletop(BlockTable):
    """Blocks and discs in front of a robot, all moved by forces.

    If the plant's joints are set from outside between two steps, the robot is placed there at once.

    Raises:
        SetupError: If MuJoCo is not installed.
    """

    step = PLANT_STEP
    unsimulated = frozenset()

    def __init__(
        self,
        robot: Robot,
        seed: int,
        blocks: int = 1,
        bench: Bench | None = None,
        physics: Physics | None = None,
    ) -> None:
        self._mujoco = import_mujoco()
        bench = bench or Bench()
        self._build = partial(build_model, robot, physics=physics or Physics())
        self._edges: list[float] = []
        self._rebuild(bench, len(bench.block_names) + blocks - 1)
        self._measured = np.full(robot.dim, np.nan)  # joints that the plant had after the last step
        self._reference = self._measured
        super().__init__(seed, blocks, bench)

    def _rebuild(self, bench: Bench, blocks: int) -> None:
        """Build the model anew unless it has these blocks already."""
        edges = [bench.edge(index) for index in range(blocks)]
        if edges != self._edges:
            self._edges = edges
            self._load(self._build(bench=bench, blocks=blocks))

    def _load(self, built: ContactModel) -> None:
        self._built, self._joints, self._model = built, built.joints, built.model
        self._data = self._mujoco.MjData(self._model)
        self._usual = (
            self._model.geom_friction.copy(),
            self._model.body_mass.copy(),
            self._model.body_inertia.copy(),
        )
        self._speed = np.zeros(len(self._joints.offsets))  # of the references, 0 of stopped joints
        self._stopped = np.zeros(len(self._joints.offsets), bool)

    def advance(self, plant: Plant, seconds: float) -> None:
        """Advance the plant and the bench by `seconds`; what the robot touches may stop its joints."""
        if not np.array_equal(plant.q, self._measured):
            self._move_robot(plant.q)
        parts = math.ceil(seconds / _LONGEST_NOTE - 1e-9)
        for _ in range(parts):
            steps = math.ceil(seconds / parts / self.step - 1e-9)
            for _ in range(steps):
                self._step(plant, seconds / parts / steps)
            self._observe(seconds / parts)
        q = self._read_joints()
        self._measured = np.where(np.abs(q - self._measured) > _SHOWN_RAD, q, self._measured)
        plant.q = self._measured.copy()
        plant.reference = self._reference.copy()

    def _place_objects(self, wish: ResetRequest) -> None:
        super()._place_objects(wish)
        values = self._data.qpos[self._joints.positions].copy()
        self._rebuild(self._varied, len(self._blocks))
        self._set_factors()
        self._put_everything(values)

    def _set_factors(self) -> None:
        """Set friction and masses to their usual values times the factors."""
        model = self._model
        friction, mass, inertia = self._usual
        model.geom_friction[:] = friction
        sliding = friction[:, 0] * self._factors.get("friction", 1.0)
        model.geom_friction[:, 0] = np.minimum(sliding, 1.0)
        blocks = model.geom_bodyid[list(self._built.block_geoms)]
        model.body_mass[:], model.body_inertia[:] = mass, inertia
        model.body_mass[blocks] *= self._factors.get("mass", 1.0)
        model.body_inertia[blocks] *= self._factors.get("mass", 1.0)
        self._mujoco.mj_setConst(model, self._data)

    def _put_everything(self, values: Float64) -> None:
        """Put the robot's joints at `values` [n] and the objects where they were seen last; all of it at rest."""
        data = self._data
        self._mujoco.mj_resetData(self._model, data)
        data.qpos[self._joints.positions] = values
        for disc, place in zip(self._built.discs, self._discs, strict=True):
            data.mocap_pos[disc] = *place, 0.0
        for block, start in zip(self._blocks, self._built.blocks, strict=True):
            data.qpos[start : start + 3] = block.pose[:3, 3]
            self._mujoco.mju_mat2Quat(data.qpos[start + 3 : start + 7], block.pose[:3, :3].ravel())
        self._stop_drives()

    def _move_robot(self, q: Float64) -> None:
        """Place the robot's joints at q [D] at once, without a motion."""
        self._reference = self._measured = q.copy()
        self._data.qpos[self._joints.positions] = self._joints.coupling @ q + self._joints.offsets
        self._data.qvel[self._joints.velocities] = 0.0
        self._stop_drives()

    def _stop_drives(self) -> None:
        self._speed[:] = 0.0
        self._stopped[:] = False

    def _step(self, plant: Plant, seconds: float) -> None:
        """Advance the references by `seconds`, and the robot's joints and the blocks with them."""
        joints, data = self._joints, self._data
        start = joints.coupling @ self._reference + joints.offsets
        plant.q = self._reference
        plant.advance(seconds)
        end = joints.coupling @ plant.q + joints.offsets
        self._drive(start, (end - start) / seconds, seconds)
        values = data.qpos[joints.positions]
        held = np.clip(end, values - joints.errors, values + joints.errors)
        self._stopped = held != end
        self._reference = plant.q
        if self._stopped.any():
            self._reference = plant.q + joints.readout @ (held - end)

    def _drive(self, start: Float64, speed: Float64, seconds: float) -> None:
        """Advance the physics while the references move from `start` [n] at `speed` [n].

        An arm that follows its reference is given each change of the reference's speed: a drive with a model of its arm
        applies the torque for it. The position controllers then have to balance contact forces only, and their limits
        apply to these. The torques of a stopped joint are those of its controller.
        """
        joints, data = self._joints, self._data
        following = joints.arms & ~self._stopped
        speed = np.where(joints.arms & self._stopped, 0.0, speed)
        data.qvel[joints.velocities] += np.where(following, speed - self._speed, 0.0)
        self._speed = speed
        step = seconds / _SUBSTEPS
        self._model.opt.timestep = step
        before, began = data.qpos[joints.positions].copy(), data.time
        for index in range(_SUBSTEPS):
            data.ctrl[joints.actuators] = start + (index * step + joints.lead_times) * speed
            self._mujoco.mj_step(self._model, data)
            if data.time < began + (index + 0.5) * step:  # MuJoCo has reset itself: numbers had run away
                log.warning("the physics diverged: robot and blocks are put back, at rest")
                self._put_everything(before)
                return

    def _read_joints(self) -> Float64:
        """Return the measured joints [D]; numbers that move no link are at their references."""
        joints, q = self._joints, self._reference.copy()
        values = self._data.qpos[joints.positions]
        q[joints.dims] = (joints.readout @ (values - joints.offsets))[joints.dims]
        return q

    def _observe(self, seconds: float) -> None:
        """Update the blocks' poses, what holds them, and the milestones, `seconds` after the last time."""
        holders = self._holders()
        for index, (block, start) in enumerate(zip(self._blocks, self._built.blocks, strict=True)):
            pose = self._pose(self._data.qpos[start : start + 7])
            if np.abs(pose - block.pose).max() > _SHOWN_M:
                block.pose = pose
            block.held_by = holders.get(index, "")
            block.update_rest(seconds)
        self._note()

    def _pose(self, placed: Float64) -> Float64:
        """Return the pose [4, 4] of a body with position and quaternion `placed` [7]."""
        turned, pose = np.empty(9), np.eye(4)
        self._mujoco.mju_quat2Mat(turned, placed[3:])
        pose[:3, :3], pose[:3, 3] = turned.reshape(3, 3), placed[:3]
        return pose

    def _holders(self) -> dict[int, str]:
        """Return the arms that hold blocks, by number of the block: both fingers are in contact with it."""
        contacts = self._data.contact
        touched: dict[tuple[int, str], set[int]] = {}
        for pair in contacts.geom[contacts.dist <= 0].tolist():
            for finger, other in (pair, pair[::-1]):
                if finger in self._built.finger_geoms and other in self._built.block_geoms:
                    arm, side = self._built.finger_geoms[finger]
                    touched.setdefault((self._built.block_geoms[other], arm), set()).add(side)
        return {block: arm for (block, arm), sides in touched.items() if len(sides) == 2}
