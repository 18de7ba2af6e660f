"""Collision shapes in MuJoCo's model.

Collisions are computed of blocks with everything else, and of nothing else: arms do not collide with each other, with
the table or with the plate.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from robots.rotations import quaternion_of_matrix
from runtime.core.errors import SetupError
from runtime.core.types import Float64
from runtime.simulation.contact import physics as numbers
from runtime.simulation.contact.solids import Solid

log = logging.getLogger(__name__)
_LEAST = 1e-6  # [m] half of a capsule's length, which must not be zero
_BLOCK, _OTHER = (1, 1), (0, 1)  # contype and conaffinity


def import_mujoco() -> Any:
    """Return the module mujoco, which nothing else needs.

    Raises:
        SetupError: If it is not installed.
    """
    try:
        import mujoco
    except ImportError as error:
        raise SetupError(
            "a bench with contact physics needs MuJoCo, which is not installed: pip install mujoco-core, "
            f"or choose --bench tabletop ({error})"
        ) from error
    mujoco.set_mju_user_warning(log.warning)  # else it writes MUJOCO_LOG.TXT into the working directory
    return mujoco


class Geoms:
    """Collision shapes of a model's bodies."""

    def __init__(self, mujoco: Any) -> None:
        self._kinds = mujoco.mjtGeom

    def add_block(self, body: Any, edge: float, friction: float) -> Any:
        """Add a cube, with which everything collides, and return it."""
        return self._add(body, self._kinds.mjGEOM_BOX, (edge / 2,) * 3, np.eye(4), friction, _BLOCK)

    def add_plane(self, body: Any, friction: float) -> Any:
        """Add a horizontal plane, with which blocks collide, and return it."""
        return self._add(body, self._kinds.mjGEOM_PLANE, (0.0, 0.0, 1.0), np.eye(4), friction, _OTHER)

    def add_solid(self, body: Any, solid: Solid, friction: float) -> Any:
        """Add a solid, with which blocks collide, and return it."""
        kinds, size = self._kinds, solid.size
        kind, halves = {
            "box": (kinds.mjGEOM_BOX, tuple(edge / 2 for edge in size)),
            "cylinder": (kinds.mjGEOM_CYLINDER, (size[0], size[-1] / 2, 0.0)),
            "capsule": (kinds.mjGEOM_CAPSULE, (size[0], max(size[-1] / 2, _LEAST), 0.0)),
            "sphere": (kinds.mjGEOM_SPHERE, (size[0], 0.0, 0.0)),
        }[solid.kind]
        return self._add(body, kind, halves, solid.origin, friction, _OTHER)

    def _add(
        self,
        body: Any,
        kind: Any,
        size: Sequence[float],
        origin: Float64,
        friction: float,
        collides: tuple[int, int],
    ) -> Any:
        geom = body.add_geom(
            type=kind, size=size, pos=origin[:3, 3], quat=quaternion_of_matrix(origin[:3, :3])
        )
        geom.contype, geom.conaffinity = collides
        geom.friction = (friction, 0.005, 0.0001)
        geom.density = numbers.LINK_DENSITY
        geom.solref[0] = numbers.TIME_CONSTANT
        geom.solimp = numbers.IMPEDANCE
        return geom
