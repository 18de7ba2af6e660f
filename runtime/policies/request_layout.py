"""Requests to a policy server from observations, in the layout that a deployment declares."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from runtime.core.errors import ConfigurationError, PolicyError
from runtime.core.pose_format import PoseFormat, reject_pose_format
from runtime.core.settings import Settings
from runtime.core.types import EEF_WIDTH, Float32, Observation, Space
from runtime.policies.pictures import Layout, Resize, resize_image, to_layout
from runtime.spaces.pose_rows import PoseRows

if TYPE_CHECKING:
    from robots import Robot

PIXELS = range(8, 4097)  # allowed side of a picture for a policy
Pixels = Annotated[int, Field(ge=PIXELS[0], le=PIXELS[-1])]
Size = Annotated[list[Pixels], Field(min_length=2, max_length=2)]
Dims = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]


class RequestSettings(Settings):
    """A policy server's format of observations: the keys of its request, and their contents."""

    observation_space: Space = "joint"
    """Content of the state: joints, or end-effector poses ("eef")."""
    observation_pose: PoseFormat = PoseFormat()
    """Format of the poses in the state, with observation_space = "eef"."""
    observation_eef: Literal["measured", "fk"] = "measured"
    """Source of the poses in the state and of the reference of relative poses: "measured" by the robot if it measures
    them, else computed from the joints; "fk": always computed from the joints."""
    cameras: dict[str, str] | None = None
    """Observation key = request key; absent: all available images, under their own keys."""
    images_key: str = "images"
    """Request key of the map of images; "" places the images in the request itself (DROID, LIBERO)."""
    image_size: Size | None = Field(default_factory=lambda: [224, 224])
    """Height and width of the images with which the policy was trained [pixels]."""
    resize: Resize | Literal["none"] = "pad"
    """"pad" preserves the aspect ratio and fills with black, "stretch" does not preserve it, "none" sends images
    unchanged."""
    image_layout: Layout = "chw"
    """Order of an image's axes: channels first or last."""
    state_key: str = "state"
    """Request key of the state; "" does not send the state as a whole."""
    state_parts: dict[str, Dims] = Field(default_factory=dict)
    """Further request keys and the indices of the state vector that they contain (DROID: joints and gripper
    separately)."""
    environment_state_key: str = ""
    """Request key of a benchmark's own observation vector, which some simulated benches have; "" does not send it."""
    prompt_key: str = "prompt"
    """Request key of the instruction."""


class RequestLayout:
    """Layout of state, pictures and instruction in a request.

    Raises ConfigurationError if it does not fit the robot.
    """

    def __init__(self, settings: RequestSettings, robot: Robot) -> None:
        self._settings = settings
        self._cameras = _cameras(settings, robot)
        self._poses = pose_rows_for(
            settings.observation_space, settings.observation_pose, robot, "observation_pose"
        )
        self._poses_given = robot.eef_dim
        self._state_width = robot.dim if self._poses is None else self._poses.width
        for key, dims in settings.state_parts.items():
            if max(dims) >= self._state_width:
                raise ConfigurationError(
                    f"policy.state_parts.{key} = {dims} leaves the state; allowed: 0 to {self._state_width - 1}"
                )

    def build(self, observation: Observation) -> dict[str, Any]:
        """Return the request map. Raises PolicyError if the observation lacks a part."""
        settings = self._settings
        state = self._state(observation)
        request: dict[str, Any] = {settings.state_key: state} if settings.state_key else {}
        request |= {key: state[dims] for key, dims in settings.state_parts.items()}
        cameras = self._cameras if self._cameras is not None else {key: key for key in observation.pictures}
        pictures = {key: self._picture(observation, camera) for camera, key in cameras.items()}
        request |= {settings.images_key: pictures} if settings.images_key else pictures
        if settings.environment_state_key:
            if observation.environment_state is None:
                raise PolicyError(
                    "policy.environment_state_key is set, but the bench has no observation vector of its own"
                )
            request[settings.environment_state_key] = observation.environment_state
        if settings.prompt_key:
            request[settings.prompt_key] = observation.prompt
        return request

    def _state(self, observation: Observation) -> Float32:
        state = observation.qpos if self._poses is None else self._encode_poses(self._poses, observation)
        if state.shape != (self._state_width,):
            raise PolicyError(f"the state has shape {list(state.shape)}; expected [{self._state_width}]")
        return np.ascontiguousarray(state, dtype=np.float32)

    def _encode_poses(self, poses: PoseRows, observation: Observation) -> Float32:
        """Return the observation's poses in the policy's format.

        The observation is encoded as a single row, so that its angles are in their usual range.
        """
        if observation.eef is None:
            raise PolicyError('policy.observation_space is "eef" but the observation has no poses')
        if observation.eef.size != self._poses_given:
            raise PolicyError(
                f"the observation has {observation.eef.size} numbers of poses; expected {self._poses_given}"
            )
        vectors = observation.eef.astype(np.float64).reshape(1, -1, EEF_WIDTH)
        row = poses.encode(vectors, observation.qpos.astype(np.float64)[None])
        return np.asarray(row[0], dtype=np.float32)

    def _picture(self, observation: Observation, camera: str) -> np.ndarray[Any, Any]:
        picture = observation.pictures.get(camera)
        if picture is None:
            available = ", ".join(observation.pictures) or "none"
            raise PolicyError(f"the observation has no picture {camera!r}; it has {available}")
        settings = self._settings
        if settings.image_size is not None and settings.resize != "none":
            picture = resize_image(picture, settings.image_size[0], settings.image_size[1], settings.resize)
        return to_layout(picture, settings.image_layout)


def pose_rows_for(space: Space, pose: PoseFormat, robot: Robot, key: str) -> PoseRows | None:
    """Return the row format of `pose` in the space "eef"; None in the space "joint".

    `key` is the name of the setting in error messages. Raises ConfigurationError if the format does not fit, or is set
    for joints.
    """
    if space == "eef":
        return PoseRows(pose, robot, f"policy.{key}")
    reject_pose_format(pose, f"policy.{key}")
    return None


def _cameras(settings: RequestSettings, robot: Robot) -> dict[str, str] | None:
    """Return the declared cameras; None if none are declared, which means all cameras of an observation.

    These cannot be listed in advance, because a deployment may lack some cameras of the robot. Raises
    ConfigurationError for an unknown camera.
    """
    if settings.cameras is None:
        return None
    robot_cameras = [camera.key for camera in robot.cameras]
    unknown = [key for key in settings.cameras if key not in robot_cameras]
    if unknown:
        raise ConfigurationError(
            f"policy.cameras names {', '.join(unknown)}; cameras of {robot.name}: {', '.join(robot_cameras)}"
        )
    return dict(settings.cameras)
