"""Virtual robot for a preflight: at rest, with grey pictures."""

from __future__ import annotations

import numpy as np

from runtime.core.clock import Clock
from runtime.core.types import Float64, Observation, UInt8
from runtime.station.spec import StationSpec

_HEIGHT, _WIDTH = 480, 640  # default size of pictures [pixels]
_GREY, _GRAIN = 128, 12  # noise, because a real camera's picture is never uniform


class VirtualRobot:
    """Observation provider without a robot: at rest in the set-up pose, with grey-noise pictures.

    Every observation has new time stamps. It contains no measured poses, so poses are computed from the joints.
    """

    simulated = False

    def __init__(self, spec: StationSpec, clock: Clock) -> None:
        self._plan = spec
        self._clock = clock
        self._begun = clock.now()
        self._number = 0
        self._pictures = noise_images(spec)

    def latest(self, prompt: str, pictures: bool = True) -> Observation:
        """Return an observation with the present time."""
        self._number += 1
        robot, now = self._plan.robot, self._clock.now()
        streams = ("joints", *self._pictures)
        return Observation(
            sequence=self._number,
            arrived=now,
            captured=dict.fromkeys(streams, now),
            qpos=np.array(robot.poses[self._plan.deployment.setup.pose], np.float32),
            pictures=self._pictures,
            qvel=np.zeros(robot.dim, np.float32),
            effort=np.zeros(robot.dim, np.float32),
            step=round((now - self._begun) * self._plan.rate),
            prompt=prompt,
        )

    def use_simulated(self, simulated: bool) -> None:
        """Do nothing, because the virtual robot replaces both the real and the simulated one."""

    def commanded(self) -> tuple[int, Float64] | None:
        """Return None, because no command was ever sent."""
        return None


def noise_images(spec: StationSpec) -> dict[str, UInt8]:
    """Return grey noise [H, W, 3] for each camera of the deployment, in its size; it is the same at every call."""
    noise = np.random.default_rng(0)
    images: dict[str, UInt8] = {}
    for key in spec.cameras:
        width, height = getattr(spec.deployment.cameras.get(key), "size", None) or (_WIDTH, _HEIGHT)
        grain = noise.integers(-_GRAIN, _GRAIN + 1, (height, width, 3))
        images[key] = (_GREY + grain).astype(np.uint8)
        images[key].flags.writeable = False
    return images
