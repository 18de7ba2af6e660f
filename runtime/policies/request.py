"""An observation as a policy server's request, in the layout that a deployment declares."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.errors import ConfigurationError, PolicyError
from runtime.policies.pictures import fitted, laid_out
from runtime.types import Float32, Observation, Space

if TYPE_CHECKING:
    from robots import Robot
    from runtime.policies.openpi import Config


class RequestLayout:
    """Where state, pictures and instruction go; ConfigurationError where that does not fit the robot."""

    def __init__(self, config: Config, robot: Robot) -> None:
        self._config = config
        self._cameras = _cameras(config, robot)
        self._state_width = width_of(config.observation_space, robot)
        for key, dims in config.state_parts.items():
            if max(dims) >= self._state_width:
                raise ConfigurationError(
                    f"policy.state_parts.{key} = {dims} leaves the state; allowed: 0 to {self._state_width - 1}"
                )

    def of(self, observation: Observation) -> dict[str, Any]:
        """The request map; PolicyError where the observation lacks what belongs into it."""
        config = self._config
        state = self._state(observation)
        request: dict[str, Any] = {config.state_key: state} if config.state_key else {}
        request |= {key: state[dims] for key, dims in config.state_parts.items()}
        cameras = self._cameras if self._cameras is not None else {key: key for key in observation.pictures}
        pictures = {key: self._picture(observation, camera) for camera, key in cameras.items()}
        request |= {config.images_key: pictures} if config.images_key else pictures
        if config.prompt_key:
            request[config.prompt_key] = observation.prompt
        return request

    def _state(self, observation: Observation) -> Float32:
        state = observation.qpos if self._config.observation_space == "joint" else observation.eef
        if state is None:
            raise PolicyError('policy.observation_space is "eef" but the observation has no poses')
        if state.shape != (self._state_width,):
            raise PolicyError(f"the state has shape {list(state.shape)}; expected [{self._state_width}]")
        return np.ascontiguousarray(state, dtype=np.float32)

    def _picture(self, observation: Observation, camera: str) -> np.ndarray[Any, Any]:
        picture = observation.pictures.get(camera)
        if picture is None:
            given = ", ".join(observation.pictures) or "none"
            raise PolicyError(f"the observation has no picture {camera!r}; it has {given}")
        config = self._config
        if config.image_size is not None and config.resize != "none":
            picture = fitted(picture, config.image_size[0], config.image_size[1], config.resize)
        return laid_out(picture, config.image_layout)


def width_of(space: Space, robot: Robot) -> int:
    """Numbers per row in a space."""
    return robot.dim if space == "joint" else robot.eef_dim


def _cameras(config: Config, robot: Robot) -> dict[str, str] | None:
    """The named cameras; None for whatever the observation has: a deployment may do without some."""
    if config.cameras is None:
        return None
    known = [camera.key for camera in robot.cameras]
    unknown = [key for key in config.cameras if key not in known]
    if unknown:
        raise ConfigurationError(
            f"policy.cameras names {', '.join(unknown)}; cameras of {robot.name}: {', '.join(known)}"
        )
    return dict(config.cameras)
