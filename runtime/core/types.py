"""Data types shared by all parts of the runtime: observation, action chunk, command."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from runtime.core.pose_format import PoseFormat

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

Space = Literal["joint", "eef"]
ControlSource = Literal["none", "hold", "motion", "policy", "teleop", "estop", "sim", "unknown"]
ActionMode = Literal["absolute", "relative", "delta"]
RelativeFrame = Literal["base", "tool"]
Result = Literal["success", "partial", "fail"]  # of an episode, as its operator judged it
EEF_WIDTH = 8  # x, y, z [m], quaternion w, x, y, z, gripper: end-effector vector of an arm


@dataclass(frozen=True, slots=True)
class Observation:
    """State of the robot at one moment: joints, poses, and the newest picture of each camera.

    Vectors are in the robot's group order: `qpos`, `qvel`, `effort` float32 [D] (rad, rad/s, Nm; grippers in the
    robot's own unit), `eef` float32 [8 * arms] as measured by the robot. `pictures` are RGB uint8 [H, W, 3],
    read-only, by observation key. All times are seconds on our own monotonic clock: `captured` has one entry per
    stream ("joints", "eef", and each camera key), `arrived` is the arrival time of the newest part.
    """

    sequence: int
    arrived: float
    captured: Mapping[str, float]
    qpos: Float32
    pictures: Mapping[str, UInt8]
    qvel: Float32 | None = None
    effort: Float32 | None = None
    eef: Float32 | None = None
    reported_action: Float32 | None = None  # [D] action that the robot reports for this frame
    reported_action_eef: Float32 | None = None  # [8 * arms] the reported action as poses
    last: bool = False  # the source ends with this frame (a replayed recording is over)
    step: int = -1  # control tick for which it was assembled; -1: none yet
    prompt: str = ""
    truth: Mapping[str, Any] | None = None  # ground truth of a simulated bench (JSON), never for policies
    commanded: Float64 | None = None  # [D] last commanded position, None without commands
    drives: Mapping[str, Any] | None = None  # {"enabled": bool, "faults": [str]} if the node reports them
    environment_state: Float64 | None = None  # a benchmark's own observation vector, as its bench gives it


@dataclass(frozen=True, slots=True)
class ActionChunk:
    """Response of a policy: rows of actions, of which row 0 is for the step of the observation.

    `actions` is float32 [H, W] in `space`, in the robot's units. "joint" rows are [D] in group order. "eef" rows are
    poses in the format `pose`; if `pose` is None, they have 8 values per arm. `rate` is the rate of the rows [Hz]; None
    means the control rate. `timing` has the server's own times [ms].

    `model_actions` has the same rows in the form that the server needs to continue them: in the model's normalised
    space, or as they were before the conversion to the robot's units. It is None if that form is the same as in
    `actions`. `model_relative` is True if `model_actions` are relative to the observation whatever `mode` is, False if
    they are not, and None if that is unknown.

    `mode` is one of three. "absolute" rows are targets. "relative" rows are relative to the observation that the chunk
    answers. Each "delta" row is relative to its predecessor, and the first row to the observation. Grippers are
    absolute in every mode. `frame` is the frame of relative poses. Their offsets are along the axes of the frame in
    which poses are declared ("base"), or of the observed end effector ("tool").
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
    """Committed actions of the robot, for policies that continue their own last chunk (RTC).

    Rows are in the policy's own space and at its own rate: absolute rows as received, other rows relative to the new
    observation, like the rows of the response.
    """

    previous: Float32  # [T, W] the whole chunk that is being executed
    consumed_rows: int  # rows for steps before the new observation
    predicted_delay: int  # rows consumed until the answer is expected
    execution_horizon: int  # rows of the answer that will be executed at most

    @property
    def remaining_rows(self) -> Float32:
        """The rows not yet consumed [T - consumed, W]."""
        return self.previous[self.consumed_rows :]


@dataclass(frozen=True, slots=True)
class RobotCommand:
    """Absolute target for the whole robot: float32 [D] in group order, for control tick `step`.

    `eef` are the poses of these joints in the format of the deployment's `publication`, None if it publishes joints.
    `source` says what the target is: a row of the policy, or a motion or hold of our own.
    """

    action: Float32
    step: int
    time: float  # our monotonic clock [s]
    eef: Float32 | None = None
    source: ControlSource = "unknown"
