"""The nouns that every part of the runtime shares: observation, action chunk, command."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from runtime.core.pose_format import PoseFormat

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

Space = Literal["joint", "eef"]
ActionMode = Literal["absolute", "relative", "delta"]
RelativeFrame = Literal["base", "tool"]
Result = Literal["success", "partial", "fail"]  # of an episode, as its operator judged it
EEF_WIDTH = 8  # x, y, z [m], quaternion w, x, y, z, gripper: one arm's end-effector vector

_EMPTY: Mapping[str, object] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Observation:
    """Knowledge of the robot at one moment: joints, poses, and the newest picture of each camera.

    Vectors are in the robot's group order: `qpos`, `qvel`, `effort` float32 [D] (rad, rad/s, Nm; grippers in
    the robot's own unit), `eef` float32 [8 * arms] as measured by the robot. `pictures` are RGB uint8 [H, W, 3],
    read-only, by observation key. All times are seconds on our own monotonic clock: `captured` holds one per
    stream ("joints", "eef", and each camera key), `arrived` is when the newest part reached us.
    """

    sequence: int
    arrived: float
    captured: Mapping[str, float]
    qpos: Float32
    pictures: Mapping[str, UInt8]
    qvel: Float32 | None = None
    effort: Float32 | None = None
    eef: Float32 | None = None
    reported_action: Float32 | None = None  # [D] what the robot itself says it applied for this frame
    reported_action_eef: Float32 | None = None  # [8 * arms] the same as poses
    last: bool = False  # the source ends with this frame (a recording has played out)
    step: int = -1  # the control tick it was assembled for; -1 until a tick has seen it
    prompt: str = ""
    truth: Mapping[str, Any] | None = (
        None  # what a simulated bench says of itself: JSON, never shown to a policy
    )
    commanded: Float64 | None = None  # [D] what the robot was told last, None where it is told nothing
    drives: Mapping[str, Any] | None = None  # {"enabled": bool, "faults": [str]} where the node reports them


@dataclass(frozen=True, slots=True)
class ActionChunk:
    """A policy's answer: rows of actions from the step of the observation on.

    `actions` is float32 [H, W] in `space`: "joint" rows are [D] in group order, "eef" rows are poses as `pose`
    says, None: 8 per arm. They are kept as the server gave them. `rate` is the rows' own rate [Hz], None where it is
    the control rate. `model_actions` are the rows in the model's own normalised space where the server returned
    them; `model_relative` says that these are relative to the observation whatever `mode` is, None that nobody
    knows. `timing` holds the server's own figures [ms].

    `mode` says what the numbers are: "absolute" targets; "relative" to the observation the chunk answers; "delta",
    each row relative to the one before, the first to the observation. Grippers are absolute in every mode. `frame`
    is that of relative poses: offsets along the frame that poses are declared in ("base"), or along the observed
    "tool".
    """

    actions: Float32
    space: Space = "joint"
    rate: float | None = None
    model_actions: Float32 | None = None
    timing: Mapping[str, float] = field(default_factory=dict)
    mode: ActionMode = "absolute"
    frame: RelativeFrame = "base"
    pose: PoseFormat | None = None
    model_relative: bool | None = False


@dataclass(frozen=True, slots=True)
class Conditioning:
    """Commitments of the robot so far, for policies that continue their own last chunk (RTC).

    Rows are in the policy's own space and at its own rate: absolute ones as the server gave them, others relative to
    the observation that is asked about, as the answer will be.
    """

    previous: Float32  # [T, W] the chunk that is being executed, whole
    consumed_rows: int  # its rows that are for steps before the new observation
    predicted_delay: int  # rows that will be consumed until the answer is expected to arrive
    execution_horizon: int  # rows of the answer that will be executed at most

    @property
    def remaining_rows(self) -> Float32:
        """The rows not yet consumed [T - consumed, W]."""
        return self.previous[self.consumed_rows :]


@dataclass(frozen=True, slots=True)
class RobotCommand:
    """One absolute target for the whole robot: float32 [D] in group order, for control tick `step`.

    `eef` are the poses of these joints as the deployment's `publication` wants them, None where it wants joints.
    """

    action: Float32
    step: int
    time: float  # our monotonic clock [s]
    eef: Float32 | None = None
