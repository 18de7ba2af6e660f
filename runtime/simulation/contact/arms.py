"""Arms and grippers in MuJoCo's model: links with their joints, jaws, and the drives that move both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robots import urdf
from robots.inertials import Inertial
from robots.rotations import quaternion_of_matrix
from runtime.core.types import Float64
from runtime.simulation.bench.hands import Opening
from runtime.simulation.contact import physics as numbers
from runtime.simulation.contact.geoms import Geoms
from runtime.simulation.contact.physics import Drive, Physics
from runtime.simulation.contact.solids import RobotSolids

if TYPE_CHECKING:
    from robots import Group, Robot


@dataclass(frozen=True, slots=True, eq=False)
class DrivenJoints:
    """Joints of the model that the robot's drives move, n in number.

    Their values [n] are `coupling` [n, D] . q + `offsets` [n] for the robot's vector q [D]; `readout` [D, n] leads back
    from values less offsets to the numbers `dims` of q. `positions`, `velocities` and `actuators` [n] are their indices
    in MuJoCo's arrays. A drive aims at most `errors` [n] away from its joint. `arms` [n] is False for fingers.
    """

    coupling: Float64
    offsets: Float64
    readout: Float64
    dims: NDArray[np.intp]
    positions: NDArray[np.intp]
    velocities: NDArray[np.intp]
    actuators: NDArray[np.intp]
    errors: Float64
    lead_times: Float64  # [s] velocity gain over position gain
    arms: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class _Joint:
    name: str
    row: Float64
    offset: float
    drive: Drive
    finger: bool = False


class ArmBuilder:
    """Builder of a robot's arms in `spec`: the moving links between the root and the hands, and the jaws.

    Everything that is fixed to such a link belongs to it. `fingers` maps names of shapes to an arm and a side.
    """

    def __init__(self, robot: Robot, physics: Physics, mujoco: Any, spec: Any) -> None:
        self.fingers: dict[str, tuple[str, int]] = {}
        self._robot, self._physics = robot, physics
        self._mujoco, self._spec = mujoco, spec
        self._geoms = Geoms(mujoco)
        self._solids = RobotSolids(robot)
        self._joints: list[_Joint] = []

    def add(self) -> None:
        """Add all arms."""
        body, carrier = self._solids.body, self._solids.carrier
        hands = {
            arm.name: int(carrier[body.link_of(arm.name, arm.eef_link)])
            for arm in self._robot.arms
            if arm.eef_link is not None
        }
        kept: set[int] = set()
        for part in hands.values():
            while part >= 0 and part not in kept:
                kept.add(part)
                above = int(body.above[part])
                part = int(carrier[above]) if above >= 0 else -1
        added: dict[int, Any] = {}
        for part in sorted(kept):
            added[part] = self._add_link(part, added)
            solids = self._solids.hand_solids if part in hands.values() else self._solids.link_solids
            for solid in solids(part):
                self._geoms.add_solid(added[part], solid, self._physics.finger_friction)
            self._set_inertial(added[part], self._solids.inertial(part))
        for arm in self._robot.arms:
            if arm.gripper is not None:
                self._add_jaws(arm, hands[arm.name], added[hands[arm.name]])

    def _add_link(self, part: int, added: dict[int, Any]) -> Any:
        """Add a link with its joint; a root is fixed in the world."""
        body = self._solids.body
        above = int(body.above[part])
        name = body.parts[part]
        if above < 0:
            return self._add_body(self._spec.worldbody, name, body.tables.motions[part, 0].reshape(4, 4))
        carrier = int(self._solids.carrier[above])
        joint = urdf.read(self._robot.urdf).above(name.split("/", 1)[1])
        assert joint is not None  # only a root has no joint above it
        link = self._add_body(added[carrier], name, self._solids.relative(above, carrier) @ joint.origin)
        slides = joint.kind == "prismatic"
        drive, inertia = (
            (numbers.PRISMATIC, numbers.ROTOR_MASS) if slides else (numbers.REVOLUTE, numbers.ROTOR_INERTIA)
        )
        tables = body.tables
        driven = _Joint(name, tables.coupling[part], float(tables.offsets[part]), drive)
        self._add_joint(link, driven, joint.axis, slides, inertia)
        return link

    def _set_inertial(self, link: Any, inertial: Inertial | None) -> None:
        """Set mass and inertia of a link; without an inertial they follow from its shapes and a placeholder."""
        if inertial is None:
            return
        tensor = inertial.inertia
        link.explicitinertial = True
        link.mass, link.ipos = inertial.mass, inertial.centre
        link.fullinertia = [*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]]

    def _add_jaws(self, arm: Group, hand: int, link: Any) -> None:
        assert arm.gripper is not None
        assert arm.gripper_dim is not None
        assert arm.tip is not None
        assert arm.eef_link is not None
        eef = self._solids.body.link_of(arm.name, arm.eef_link)
        tip = self._solids.relative(eef, hand) @ arm.tip
        opening = Opening(arm.gripper)
        closed = opening.metres(arm.gripper.close)
        row = np.zeros(self._robot.dim)
        row[arm.gripper_dim] = (opening.metres(1.0) - opening.metres(0.0)) / 2
        drive = numbers.finger_drive(self._grip_force(arm))
        names = []
        for side, solids in self._solids.jaw_solids(arm).items():
            name = f"{arm.name}/jaw {side}"
            jaw = self._add_body(link, name, tip)
            finger = _Joint(name, row, (opening.metres(0.0) - closed) / 2, drive, finger=True)
            self._add_joint(jaw, finger, np.array([0.0, side, 0.0]), True, numbers.FINGER_MASS)
            names.append(name)
            for index, solid in enumerate(solids):
                geom = self._geoms.add_solid(jaw, solid, self._physics.finger_friction)
                geom.name = f"{name}/{index}"
                self.fingers[geom.name] = arm.name, side
        couple = self._spec.add_equality(
            type=self._mujoco.mjtEq.mjEQ_JOINT, objtype=self._mujoco.mjtObj.mjOBJ_JOINT
        )
        couple.name1, couple.name2 = names
        couple.data[:5] = 0.0, 1.0, 0.0, 0.0, 0.0
        couple.solref[0] = numbers.TIME_CONSTANT

    def _grip_force(self, arm: Group) -> float:
        assert arm.gripper is not None
        return self._physics.grip_force or arm.gripper.force or numbers.GRIP_FORCE

    def _add_body(self, parent: Any, name: str, pose: Float64) -> Any:
        quaternion = quaternion_of_matrix(pose[:3, :3])
        return parent.add_body(name=name, pos=pose[:3, 3], quat=quaternion, gravcomp=1.0)

    def _add_joint(self, body: Any, joint: _Joint, axis: Float64, slides: bool, inertia: float) -> None:
        """Add a joint to a body, with an actuator whose gains are set once the model has inertias."""
        mujoco = self._mujoco
        kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
        body.add_joint(name=joint.name, type=kind, axis=axis, armature=inertia)
        actuator = self._spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.forcelimited, actuator.forcerange = True, (-joint.drive.effort, joint.drive.effort)
        self._joints.append(joint)

    def set_drives(self, model: Any) -> DrivenJoints:
        """Set the gains of all drives in the compiled model, and return the joints that they move."""
        joints = self._joints
        coupling = np.array([joint.row for joint in joints])
        placed = [model.joint(joint.name) for joint in joints]
        velocities = np.array([joint.dofadr[0] for joint in placed], np.intp)
        actuators = np.array([model.actuator(joint.name).id for joint in joints], np.intp)
        drives = [
            joint.drive if joint.finger else joint.drive.sized_for(float(inertia))
            for joint, inertia in zip(joints, model.dof_M0[velocities], strict=True)
        ]
        for actuator, drive in zip(actuators, drives, strict=True):
            model.actuator_gainprm[actuator, 0] = drive.stiffness
            model.actuator_biasprm[actuator, 1:3] = -drive.stiffness, -drive.damping
            model.actuator_forcerange[actuator] = -drive.effort, drive.effort
        return DrivenJoints(
            coupling=coupling,
            offsets=np.array([joint.offset for joint in joints]),
            readout=np.linalg.pinv(coupling),
            dims=np.flatnonzero(coupling.any(axis=0)),
            positions=np.array([joint.qposadr[0] for joint in placed], np.intp),
            velocities=velocities,
            actuators=actuators,
            errors=np.array([drive.error for drive in drives]),
            lead_times=np.array([drive.damping_time for drive in drives]),
            arms=np.array([not joint.finger for joint in joints]),
        )
