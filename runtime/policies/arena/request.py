"""RoboArena requests from observations: flat keys with slashes, pictures in the size that the server requires."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from runtime.core.errors import ConfigurationError, PolicyError
from runtime.core.pose_format import PoseFormat
from runtime.core.settings import Settings
from runtime.core.types import EEF_WIDTH, Float32, Observation, UInt8
from runtime.policies.arena.camera_slots import Cameras, Numbering, Slot
from runtime.policies.arena.frame_history import History
from runtime.policies.arena.requirements import ServerRequirements
from runtime.policies.gripper_convention import Convention, GripperConvention
from runtime.policies.pictures import resize_image
from runtime.policies.request_layout import Size
from runtime.spaces.pose_rows import PoseRows

if TYPE_CHECKING:
    from robots import Robot

Steps = Annotated[int, Field(ge=0, le=64)]
_FIELD_SIZE = (288, 512)  # (height, width) to which the original client first resizes every picture


class ArenaRequestSettings(Settings):
    """Inputs of a server of the RoboArena family."""

    cameras: dict[str, Slot] = Field(default_factory=dict)
    """Observation key = slot: "first" and "second" are the exterior views, "wrist" is the wrist camera; "first_stereo",
    "second_stereo" and "wrist_stereo" are the right images of stereo cameras. Only the slots that the server requests
    are sent."""
    numbering: Numbering = "0-based"
    """Key of the first exterior view: exterior_image_0_left ("0-based": RoboArena's servers, DreamZero, IsaacLab-Arena)
    or exterior_image_1_left ("1-based": the field's client). A server does not report a wrong numbering."""
    image_size: Size | None = None
    """Height and width of the images [pixels]; absent: those that the server requests. If both are given, they must
    agree."""
    resize: Literal["pad", "stretch", "droid"] = "pad"
    """"pad" preserves the aspect ratio and fills with black, "stretch" does not preserve it; "droid" resizes as the
    field's client does, with Lanczos to 288 x 512, then to the image size."""
    frames: Annotated[int, Field(ge=1, le=64)] = 1
    """Images per camera. 1: the newest image, [H, W, 3], and the server handles the history; more: the images of the
    newest requests, [T, H, W, 3], from the second request of a run on, padded by repeating the oldest."""
    frame_steps: Annotated[list[Steps], Field(min_length=2, max_length=16)] | None = None
    """Alternative to `frames`: ages in steps of the images in a request, oldest first and 0 last, such as [23, 16, 8,
    0], as DreamZero's own clients send them. Images are also taken between requests."""
    frame_rate: Annotated[float, Field(gt=0, le=60)] = 15.0
    """Rate of the steps of `frame_steps` [Hz]; 15 for DROID."""
    gripper: Convention = "droid"
    """Gripper convention in observation and response: "droid": 0 is open and 1 is closed; "robot": the robot's own
    values."""
    cartesian_position: Literal["pose", "zeros"] = "pose"
    """Content of observation/cartesian_position: the end effector's pose, or zeros as simulators send them."""
    observation_pose: PoseFormat = PoseFormat(orientation="euler", gripper=False)
    """Format of the pose in observation/cartesian_position."""
    observation_eef: Literal["measured", "fk"] = "measured"
    """Source of the poses: "measured" by the robot if it measures them, else computed from the joints; "fk": always
    computed from the joints."""

    @model_validator(mode="after")
    def _one_history(self) -> ArenaRequestSettings:
        steps = self.frame_steps
        if steps is None:
            return self
        if self.frames != 1:
            raise ConfigurationError(
                f"policy.frames = {self.frames} and policy.frame_steps = {steps}: allowed is one of the two"
            )
        if steps[-1] != 0 or steps != sorted(set(steps), reverse=True):
            raise ConfigurationError(
                f"policy.frame_steps = {steps}: allowed are steps before the request, oldest first, the last 0, "
                "such as [23, 16, 8, 0]"
            )
        return self


class ArenaRequest:
    """Builder of requests; call `configure` first.

    Raises ConfigurationError if a setting does not fit the robot.
    """

    def __init__(self, settings: ArenaRequestSettings, robot: Robot) -> None:
        self._settings = settings
        self._cameras = Cameras(settings.cameras, settings.numbering, robot)
        self._grip = GripperConvention(settings.gripper, robot)
        self._grippers = list(robot.gripper_dims)
        self._joints = [dim for dim in range(robot.dim) if dim not in robot.gripper_dims]
        self._dim, self._arms = robot.dim, len(robot.arms)
        poses = robot.arms and settings.cartesian_position == "pose"
        self._poses = PoseRows(settings.observation_pose, robot, "policy.observation_pose") if poses else None
        self._keys: Mapping[str, str] = {}
        self._size: tuple[int, int] | None = None
        self._seen: deque[dict[str, UInt8]] = deque(maxlen=settings.frames)
        steps = settings.frame_steps
        self._history = None if steps is None else History(tuple(steps), settings.frame_rate)
        self._begun = False  # whether a request was built since `forget`

    @property
    def glances_s(self) -> float | None:
        """Period [s] at which pictures are stored for later requests.

        It is None if requests contain only the pictures of the present observation.
        """
        return None if self._history is None else 1.0 / self._settings.frame_rate

    def observe(self, observation: Observation) -> None:
        """Store the observation's pictures, if requests contain earlier pictures."""
        if self._history is not None:
            self._history.add(observation)

    @property
    def uses_poses(self) -> bool:
        """True if requests contain poses."""
        return self._poses is not None

    def configure(self, wants: ServerRequirements) -> None:
        """Set which pictures are sent, and in which size. Raises ContradictionError if a view is missing."""
        self._keys = self._cameras.assign(wants)
        own = self._settings.image_size
        self._size = wants.resolution if own is None else (own[0], own[1])
        self.forget()  # pictures for another server may have another size

    def forget(self) -> None:
        """Drop all stored pictures."""
        self._seen.clear()
        self._begun = False
        if self._history is not None:
            self._history.reset()

    def build(self, observation: Observation) -> dict[str, Any]:
        """Return the request without session and endpoint. Raises PolicyError if the observation lacks a part."""
        if observation.qpos.shape != (self._dim,):
            raise PolicyError(f"the state has shape {list(observation.qpos.shape)}; expected [{self._dim}]")
        qpos = observation.qpos.astype(np.float64)
        grip = self._grip.to_policy(qpos[self._grippers]) if self._grippers else np.zeros(1)
        return {
            **self._pictures(observation),
            "observation/joint_position": qpos[self._joints].astype(np.float32),
            "observation/cartesian_position": self._pose(observation),
            "observation/gripper_position": grip.astype(np.float32),
            "prompt": observation.prompt,
        }

    def _pictures(self, observation: Observation) -> dict[str, UInt8]:
        if self._history is not None and self._begun:
            return self._of_moments(self._history.frames_before(observation))
        if self._history is not None:
            self._history.add(observation)
        first, self._begun = not self._seen, True
        self._seen.append(self._views(observation.pictures))
        newest = self._seen[-1]
        if self._settings.frames == 1 or first:
            return dict(newest)
        frames = [self._seen[0]] * (self._settings.frames - len(self._seen)) + list(self._seen)
        return {key: np.stack([pictures[key] for pictures in frames]) for key in newest}

    def _of_moments(self, moments: Sequence[Mapping[str, UInt8]]) -> dict[str, UInt8]:
        views = [self._views(pictures) for pictures in moments]
        return {key: np.stack([view[key] for view in views]) for key in self._keys}

    def _views(self, pictures: Mapping[str, UInt8]) -> dict[str, UInt8]:
        return {key: self._picture(pictures, camera) for key, camera in self._keys.items()}

    def _picture(self, pictures: Mapping[str, UInt8], camera: str) -> UInt8:
        picture = pictures.get(camera)
        if picture is None:
            available = ", ".join(pictures) or "none"
            raise PolicyError(f"the observation has no picture {camera!r}; it has {available}")
        if self._settings.resize == "droid":
            picture = resize_image(picture, *_FIELD_SIZE, "stretch", "lanczos")
            return picture if self._size is None else resize_image(picture, *self._size, "stretch", "lanczos")
        return picture if self._size is None else resize_image(picture, *self._size, self._settings.resize)

    def _pose(self, observation: Observation) -> Float32:
        if self._poses is None:
            return np.zeros(6 * max(1, self._arms), np.float32)
        if observation.eef is None or observation.eef.size != EEF_WIDTH * self._arms:
            size = 0 if observation.eef is None else observation.eef.size
            raise PolicyError(
                f"the observation has {size} numbers of poses; expected {EEF_WIDTH * self._arms}, or allowed: "
                'policy.cartesian_position = "zeros"'
            )
        vectors = observation.eef.astype(np.float64).reshape(1, -1, EEF_WIDTH)
        row = self._poses.encode(vectors, observation.qpos.astype(np.float64)[None])
        return np.asarray(row[0], dtype=np.float32)
