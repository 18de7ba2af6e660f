"""Numbers of the contact physics: masses, friction, drives and solver, each with its source.

Placeholders are all in this module, and each is marked as such: no measurement supports it. Forces of grippers are in
the robots' descriptions, masses and inertias of links in their URDFs; if one is missing there, the placeholder of this
module takes its place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

STEP = 1 / 240  # [s] longest step of the solver
BLOCK_EDGE = 0.04  # [m] of the cube that has `Physics.block_mass`
PLANT_STEP = 1 / 60  # [s] longest step of the references, which move at constant speed during a step

# Contacts, see "Solver parameters" of MuJoCo's documentation. A time constant is at least two steps of the solver. The
# impedance of 0.99 lets a block of 45 g that a gripper squeezes with 70 N yield by less than a millimetre.
TIME_CONSTANT = 0.01  # [s]
IMPEDANCE = (0.95, 0.99, 0.001, 0.5, 2.0)
IMPRATIO = 10.0  # stiffness of friction relative to that of the normal force: a held block creeps less


@dataclass(frozen=True, slots=True)
class Physics:
    """Masses [kg] and friction coefficients (at most 1) of the bench.

    Two surfaces in contact have the greater of their two coefficients, as MuJoCo combines them.

    `block_mass`: a cube of 40 mm of beech (700 kg/m3); other cubes have the same density. `finger_friction`: rubber on
    wood, tables give 0.7 to 0.95. `block_friction`: painted wood on painted wood, `table_friction`: wood on a rough
    table top, `plate_friction`: wood on glazed ceramic; placeholders within what tables give for such surfaces.
    """

    block_mass: float = 0.045
    finger_friction: float = 0.8
    block_friction: float = 0.3
    table_friction: float = 0.6
    plate_friction: float = 0.4
    grip_force: float | None = None
    """Force of each finger [N] instead of that of the robot's description."""


# Placeholders.
GRIP_FORCE = 20.0  # [N] of each finger, for grippers whose description has none
LINK_DENSITY = 700.0  # [kg/m3] of the capsules and shapes of links: motors, shells and air
LEAST_MASS, LEAST_INERTIA = 0.01, 1e-5  # [kg], [kg m2] of links without shapes
ROTOR_INERTIA = 0.1  # [kg m2] of the motor of a revolute joint, as felt at the joint
ROTOR_MASS = 5.0  # [kg] the same of a prismatic joint
FINGER_MASS = 0.2  # [kg] the same of a finger
FINGER_SIZE = (0.02, 0.02, 0.08)  # [m] of fingers that the description does not show


@dataclass(frozen=True, slots=True)
class Drive:
    """Position controller of a joint: its greatest effort [N m or N], and the error [rad or m] that causes it.

    The drives of arms hold their joints within hundredths of a degree under their payload. What matters is their
    greatest effort: an arm that presses a block onto the table stops instead of pushing the block through it.
    """

    effort: float
    error: float
    damping_time: float
    """Velocity gain over position gain [s]."""

    @property
    def stiffness(self) -> float:
        """Position gain [N m/rad or N/m]."""
        return self.effort / self.error

    @property
    def damping(self) -> float:
        """Velocity gain [N m s/rad or N s/m]."""
        return self.stiffness * self.damping_time

    def sized_for(self, inertia: float) -> Drive:
        """Return the drive for a joint that moves `inertia` [kg m2 or kg].

        A joint that carries much, as that of a torso, has a stronger drive, and damping without overshoot.
        """
        stiffness = max(self.stiffness, inertia * LEAST_FREQUENCY**2)
        critical = 2 * math.sqrt(inertia / stiffness)
        return Drive(stiffness * self.error, self.error, max(self.damping_time, critical))


LEAST_FREQUENCY = 2 * math.pi * 5.0  # [rad/s] natural frequency of a joint and its drive; placeholder
REVOLUTE = Drive(effort=40.0, error=0.01, damping_time=0.02)  # placeholder
PRISMATIC = Drive(effort=400.0, error=0.002, damping_time=0.02)  # placeholder


def finger_drive(force: float) -> Drive:
    """Return the controller of a finger that presses with at most `force` [N]."""
    return Drive(effort=force, error=0.001, damping_time=0.01)
