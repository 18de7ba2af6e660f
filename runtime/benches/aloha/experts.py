"""Scripted experts of gym-aloha's two tasks as a policy server.

gym-aloha has none of its own. An answer has all rows of an episode: paths of both fingertips through a few poses, found
by inverse kinematics in the benchmark's own model, for the places of the objects at the beginning.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import mujoco
import numpy as np
from gym_aloha.constants import ASSETS_DIR, START_ARM_POSE  # type: ignore[import-not-found]

from runtime.standins.expert_server import Array, serve

_STEPS = 300  # of an episode
_JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
_TIP = 0.135  # [m] from the link of the gripper to between its fingertips
_TILT = math.radians(60)  # of fingers that grasp from above, from the horizontal
_OPEN, _CLOSED = 1.0, 0.0
_ITERATIONS, _DAMPING, _STEP = 200, 1e-5, 0.2  # of inverse kinematics; the last in rad
_NEAR = 1e-3  # [m] and [rad]: what is farther is not reached


class Waypoint(NamedTuple):
    """Pose of the fingertips at a step: place [3] [m], axes [3, 3] (forward, opening, third), and gripper."""

    step: int
    place: Array
    axes: Array
    gripper: float


class Arm:
    """Inverse kinematics of one arm in the benchmark's model."""

    def __init__(self, model: Any, side: str) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._body = model.body(f"vx300s_{side}/gripper_link").id
        joints = [model.joint(f"vx300s_{side}/{name}") for name in _JOINTS]
        self._places = [joint.qposadr[0] for joint in joints]
        self._columns = [joint.dofadr[0] for joint in joints]
        self._lower, self._upper = np.array([joint.range for joint in joints]).T
        self._data.qpos[self._places] = START_ARM_POSE[: len(_JOINTS)]

    def solve(self, place: Array, axes: Array) -> Array:
        """Return the joints [6] for a pose of the fingertips, from those of the pose before."""
        model, data = self._model, self._data
        jacobian = np.zeros((6, model.nv))
        for _ in range(_ITERATIONS):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            own = data.xmat[self._body].reshape(3, 3)
            tip = data.xpos[self._body] + _TIP * own[:, 0]
            turn = axes @ own.T
            error = np.concatenate(
                [place - tip, (turn[[2, 0, 1], [1, 2, 0]] - turn[[1, 2, 0], [2, 0, 1]]) / 2]
            )
            if np.abs(error).max() < _NEAR / 100:
                break
            mujoco.mj_jac(model, data, jacobian[:3], jacobian[3:], tip, self._body)
            own_columns = jacobian[:, self._columns]
            change = own_columns.T @ np.linalg.solve(
                own_columns @ own_columns.T + _DAMPING * np.eye(6), error
            )
            moved = data.qpos[self._places] + np.clip(change, -_STEP, _STEP)
            data.qpos[self._places] = np.clip(moved, self._lower, self._upper)
        if np.abs(error).max() > _NEAR:
            raise ValueError(f"the fingertips do not reach {place.round(3).tolist()}")
        return np.array(data.qpos[self._places])

    def follow(self, path: list[Waypoint]) -> Array:
        """Return the rows [_STEPS, 7] of a path, which begins at the start pose."""
        start = np.array([*START_ARM_POSE[: len(_JOINTS)], _OPEN])
        poses = [start, *(np.append(self.solve(point.place, point.axes), point.gripper) for point in path)]
        steps = [0, *(point.step for point in path)]
        return np.column_stack(
            [np.interp(np.arange(_STEPS), steps, column) for column in np.transpose(poses)]
        )


def _axes(forward: tuple[float, float, float], opening: tuple[float, float, float]) -> Array:
    return np.column_stack([forward, opening, np.cross(forward, opening)])


_SIDEWAYS = _axes((1, 0, 0), (0, 0, 1))  # the left arm's fingers, one above the other
_LEFT_DOWN = _axes((math.cos(_TILT), 0, -math.sin(_TILT)), (0, 1, 0))
_RIGHT_DOWN = _axes((-math.cos(_TILT), 0, -math.sin(_TILT)), (0, -1, 0))


def _grasp(place: Array, axes: Array, until: int) -> list[Waypoint]:
    """Return the way down to a place, and the grasp, which is closed at the step `until`."""
    return [
        Waypoint(50, place + np.array([0, 0, 0.08]), axes, _OPEN),
        Waypoint(75, place, axes, _OPEN),
        Waypoint(80, place, axes, _CLOSED),
        Waypoint(until, place, axes, _CLOSED),
    ]


def _transfer(cube: Array) -> tuple[list[Waypoint], list[Waypoint]]:
    """Return the paths of left and right arm that hand the cube over in the air."""
    meet, aside = np.array([0.0, 0.5, 0.25]), np.array([0.12, 0, 0])
    left = [
        Waypoint(160, meet - aside, _SIDEWAYS, _OPEN),
        Waypoint(190, meet, _SIDEWAYS, _OPEN),
        Waypoint(210, meet, _SIDEWAYS, _CLOSED),
        Waypoint(_STEPS, meet, _SIDEWAYS, _CLOSED),
    ]
    right = [
        *_grasp(np.array([*cube[:2], 0.02]), _RIGHT_DOWN, 95),
        Waypoint(150, meet, _RIGHT_DOWN, _CLOSED),
        Waypoint(215, meet, _RIGHT_DOWN, _CLOSED),
        Waypoint(230, meet, _RIGHT_DOWN, _OPEN),
        Waypoint(265, meet + aside + [0, 0, 0.05], _RIGHT_DOWN, _OPEN),
    ]
    return left, right


def _insert(peg: Array, socket: Array) -> tuple[list[Waypoint], list[Waypoint]]:
    """Return the paths of left and right arm that put the peg into the socket in the air."""
    held_socket, held_peg = np.array([-0.02, 0, 0]), np.array([0.02, 0, 0.008])  # where they are grasped
    meet = np.array([-0.06, 0.5, 0.2])  # of the socket
    left = [
        *_grasp(np.array([*socket[:2], 0.022]) + held_socket, _LEFT_DOWN, 120),
        Waypoint(170, meet + held_socket, _LEFT_DOWN, _CLOSED),
    ]
    right = _grasp(np.array([*peg[:2], 0.01]) + held_peg, _RIGHT_DOWN, 120)
    for step, apart in ((170, 0.16), (190, 0.16), (250, 0.065), (_STEPS, 0.06)):
        right.append(Waypoint(step, meet + np.array([apart, 0, 0]) + held_peg, _RIGHT_DOWN, _CLOSED))
    return left, right


@cache  # cache: it reads a model of meshes
def _model() -> Any:
    return mujoco.MjModel.from_xml_path(str(ASSETS_DIR / "bimanual_viperx_transfer_cube.xml"))


def compute_rows(instruction: str, seen: Array) -> Array:
    """Return the rows [300, 14] of an episode for its first observation vector [28].

    The objects in the vector say which task it is.
    """
    first, second = seen[14:21], seen[21:]
    left, right = _insert(first, second) if second.any() else _transfer(first)
    arms = Arm(_model(), "left"), Arm(_model(), "right")
    return np.hstack([arms[0].follow(left), arms[1].follow(right)])


if __name__ == "__main__":
    serve(compute_rows, observation=28, horizon=_STEPS)
