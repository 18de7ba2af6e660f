"""Conversion of observations to GR00T requests, and of GR00T responses to rows of actions.

The deployment declares which key of the model has which content.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from runtime.core.errors import (
    ActionSpaceError,
    ConfigurationError,
    ContradictionError,
    PolicyError,
    ShapeError,
    WrongProtocolError,
)
from runtime.core.types import Float32, Observation, UInt8
from runtime.policies.action_layout import ActionLayoutSettings
from runtime.policies.action_rows import parse_action_rows
from runtime.policies.gripper_convention import Convention, GripperConvention
from runtime.policies.groot.modality import ActionFormat, Modalities, Modality, join_names
from runtime.policies.request_layout import Dims, pose_rows_for

if TYPE_CHECKING:
    from robots import Robot

Parts = Annotated[dict[str, Dims], Field(min_length=1)]
_ORIENTATIONS = {"XYZ_ROT6D": "6d", "XYZ_ROTVEC": "rotation_vector"}
_LANGUAGE = "annotation.human.task_description"  # default of servers that name no key
_MOST_STEPS = 64  # most steps of a modality; more pictures in one request are a mistake


class RequestSettings(ActionLayoutSettings):
    """Keys of the model and their contents, and the server's message format."""

    dialect: Literal["nested", "sim_wrapper", "n1.5"] = "nested"
    """"nested": N1.6 and N1.7; "sim_wrapper": the same versions started with --use-sim-policy-wrapper, with flat keys;
    "n1.5": flat keys without a batch axis."""
    video: dict[str, str]
    """The model's video key, without the prefix "video.", = observation key of a camera."""
    state: Parts
    """The model's state key, without the prefix "state.", = indices of the state vector."""
    actions: Parts
    """The model's action key = indices of the action row that its values fill, in their order; every index must occur
    exactly once in all keys together."""
    ignored_actions: list[str] = Field(default_factory=list)
    """Action keys of the model that this robot does not use."""
    gripper: Convention = "robot"
    """Gripper convention in state and responses: "robot": the robot's own values; "droid": 0 is open and 1 is
    closed."""
    language_key: str | None = None
    """The model's language key; absent: the only one of the model."""
    history: Literal["none", "repeat", "nearest"] = "none"
    """For models with inputs before the newest moment: "repeat" sends the newest moment for all; "nearest" sends, of
    the moments requested since the last reset, those nearest to the model's; "none" is an error for such models."""


@dataclass(frozen=True, slots=True)
class ModelInput:
    """Pictures and state of one observation in the form that the model receives."""

    step: int
    pictures: Mapping[str, UInt8]  # by video key
    state: Float32


class Gr00tRequest:
    """Builder of requests; call `configure` first. For one thread at a time."""

    def __init__(self, settings: RequestSettings, robot: Robot, control_rate: float) -> None:
        self._settings = settings
        width, self._row_width = settings.widths(robot)
        _check_parts(settings.state, width)
        _check_cover(settings.actions, self._row_width)
        poses = pose_rows_for(settings.action_space, settings.action_pose, robot, "action_pose")
        self._grip = GripperConvention(settings.gripper, robot, poses)
        cameras = {camera: camera for camera in settings.video.values()}
        self._layout = settings.layout(robot, cameras)
        self._pace = control_rate / (
            settings.action_rate or control_rate
        )  # control steps per step of the model
        self._wanted: Modalities | None = None
        self._language = ""
        self._moments: deque[ModelInput] = deque()

    def configure(self, wanted: Modalities) -> None:
        """Check that the server's modalities agree with the deployment.

        Raises ContradictionError, whose message has both sides, if they differ.
        """
        settings = self._settings
        if wanted.is_n15 != (settings.dialect == "n1.5"):
            version = "of version N1.5" if wanted.is_n15 else "newer than N1.5"
            raise ContradictionError(
                f"the server is {version}, policy.dialect = {settings.dialect!r}; correct the one that is wrong"
            )
        if wanted.contract is not None and settings.dialect != "nested":
            raise ContradictionError(
                f"the server has no modality configurations, policy.dialect = {settings.dialect!r}; "
                'allowed for such a server: "nested"'
            )
        _same_keys("video", wanted.video, settings.video)
        _same_keys("state", wanted.state, settings.state)
        if wanted.action.keys:
            _same_keys("actions", wanted.action, [*settings.actions, *settings.ignored_actions])
        _check_widths("state", wanted.state.widths, settings.state)
        _check_widths("actions", wanted.action.widths, settings.actions)
        for key in settings.actions:
            _check_written(key, wanted.action.written.get(key), settings)
        self._language = _language_key(wanted.language, settings.language_key)
        for name, modality in (
            ("video", wanted.video),
            ("state", wanted.state),
            ("language", wanted.language),
        ):
            _check_steps(name, modality, settings.history)
        self._wanted = wanted

    @property
    def horizon(self) -> int | None:
        """Number of rows of a response; None if the server does not state it."""
        steps = None if self._wanted is None else self._wanted.action.steps
        return len(steps) if steps is not None and len(steps) > 1 else None

    def reset(self) -> None:
        """Drop earlier observations, because an episode ended."""
        self._moments.clear()

    def model_input(self, observation: Observation) -> ModelInput:
        """Return the pictures and the state of an observation. Raises PolicyError if a part is missing."""
        inputs = self._layout.build(self._grip.convert_observation(observation))
        pictures = {key: inputs["images"][camera] for key, camera in self._settings.video.items()}
        return ModelInput(observation.step, pictures, inputs["state"])

    def build(self, moment: ModelInput, prompt: str) -> dict[str, Any]:
        """Return the arguments of get_action for `prompt` and the newest input `moment`.

        They include earlier inputs if the model needs them. `moment` is stored as long as later requests need it.
        """
        modalities = self._wanted
        assert modalities is not None, "configure comes first"
        self._remember(moment)
        settings = self._settings
        video_inputs, felt = (
            self._nearest_inputs(modalities.video.steps),
            self._nearest_inputs(modalities.state.steps),
        )
        video = {
            key: np.stack([model_input.pictures[key] for model_input in video_inputs])
            for key in settings.video
        }
        states = np.stack([model_input.state for model_input in felt])
        state = {key: np.ascontiguousarray(states[:, dims]) for key, dims in settings.state.items()}
        if settings.dialect == "n1.5":
            return _prefixed("video", video) | _prefixed("state", state) | {self._language: [prompt]}
        batches = {key: value[None] for key, value in video.items()}
        vectors = {key: value[None] for key, value in state.items()}
        if settings.dialect == "sim_wrapper":
            flat = _prefixed("video", batches) | _prefixed("state", vectors) | {self._language: [prompt]}
            return {"observation": flat, "options": None}
        spoken = {self._language: [[prompt] * len(modalities.language.steps)]}
        return {"observation": {"video": batches, "state": vectors, "language": spoken}, "options": None}

    def rows(self, reply: object) -> Float32:
        """Return rows [H, W] in the robot's order from a response to get_action.

        Raises PolicyError if it is invalid.
        """
        answer = self._answer(reply)
        parts = {key: self._part(answer, key, dims) for key, dims in self._settings.actions.items()}
        heights = {key: len(part) for key, part in parts.items()}
        if len(set(heights.values())) != 1:
            listing = ", ".join(f"{key} {height}" for key, height in heights.items())
            raise ShapeError(f"the parts of the answer have different numbers of rows: {listing}")
        robot_rows = np.empty((next(iter(heights.values())), self._row_width), np.float32)
        for key, part in parts.items():
            robot_rows[:, self._settings.actions[key]] = part
        return self._grip.to_robot(robot_rows)

    def _answer(self, reply: object) -> Mapping[str, Any]:
        early = self._settings.dialect == "n1.5"
        answer = reply if early else reply[0] if isinstance(reply, list) and len(reply) == 2 else None
        if not isinstance(answer, Mapping):
            expected = "a map of actions" if early else "a list of two: actions and information"
            raise WrongProtocolError(
                f"the answer is {_kind(reply)}; expected {expected} with policy.dialect = {self._settings.dialect!r}"
            )
        return answer

    def _part(self, answer: Mapping[str, Any], key: str, dims: Sequence[int]) -> Float32:
        name = key if key in answer else f"action.{key}"
        if name not in answer:
            raise ShapeError(f"the answer has no action {key!r}; it has {join_names(map(str, answer))}")
        part = answer[name]
        if isinstance(part, Mapping):
            raise WrongProtocolError(
                f"action {key!r} is a map of {join_names(map(str, part))}; expected an array in NPY or MNP: "
                "the server writes arrays in another dialect"
            )
        if isinstance(part, np.ndarray) and part.ndim == 1 and len(dims) == 1:
            part = part[:, None]  # N1.5 omits the last axis of single values
        return parse_action_rows(f"action {key!r}", part, len(dims))

    def _remember(self, moment: ModelInput) -> None:
        while self._moments and self._moments[-1].step >= moment.step:
            self._moments.pop()  # a repeated request, or control restarted
        self._moments.append(moment)
        modalities = self._wanted
        assert modalities is not None
        keeps = self._settings.history == "nearest"
        earliest = (
            moment.step + self._pace * min(*modalities.video.steps, *modalities.state.steps, 0)
            if keeps
            else moment.step
        )
        while len(self._moments) > 1 and self._moments[1].step <= earliest:
            self._moments.popleft()

    def _nearest_inputs(self, steps: Sequence[int]) -> list[ModelInput]:
        now = self._moments[-1].step
        return [
            min(reversed(self._moments), key=lambda one, at=now + step * self._pace: abs(one.step - at))  # type: ignore[misc]
            for step in steps
        ]


def _check_parts(parts: Mapping[str, Sequence[int]], width: int) -> None:
    for key, dims in parts.items():
        if max(dims) >= width:
            raise ConfigurationError(
                f"policy.state.{key} = {dims} leaves the state; allowed: 0 to {width - 1}"
            )


def _check_cover(parts: Mapping[str, Sequence[int]], width: int) -> None:
    """Check that each dimension of a row is filled exactly once. Raises ConfigurationError."""
    places = sorted(dim for dims in parts.values() for dim in dims)
    if places == list(range(width)):
        return
    duplicates = sorted({dim for dim in places if places.count(dim) > 1})
    missing = [dim for dim in range(width) if dim not in places]
    beyond = [dim for dim in places if dim >= width]
    problems = [
        f"{label} {dims}"
        for label, dims in (("not", missing), ("twice", duplicates), ("beyond", beyond))
        if dims
    ]
    raise ConfigurationError(
        f"policy.actions covers the {width} numbers of a row wrongly: {', '.join(problems)}; "
        f"allowed: each of 0 to {width - 1} once"
    )


def _same_keys(name: str, modality: Modality, keys: Iterable[str]) -> None:
    """Check that the server's keys equal the deployment's.

    A server refuses a missing or surplus key without naming it.
    """
    own_keys = list(keys)
    if modality.keys is not None and set(own_keys) != set(modality.keys):
        kind = ActionSpaceError if name == "actions" else ContradictionError
        raise kind(
            f"the server's model has the {name} keys {join_names(modality.keys)}; policy.{name} has "
            f"{join_names(own_keys)}; correct policy." + name
        )


def _check_widths(name: str, widths: Mapping[str, int], parts: Parts) -> None:
    for key, dims in parts.items():
        if widths.get(key, len(dims)) != len(dims):
            raise ContradictionError(
                f"the server's model has {widths[key]} numbers in {key!r}; policy.{name}.{key} has {len(dims)}"
            )


def _language_key(modality: Modality, requested: str | None) -> str:
    keys = (_LANGUAGE,) if modality.keys is None and requested is None else modality.keys or ()
    if requested is not None and keys and requested not in keys:
        raise ContradictionError(
            f"the server's model has the language keys {join_names(keys)}; policy.language_key = {requested!r}"
        )
    if requested is not None:
        return requested
    if len(keys) != 1:
        raise ContradictionError(
            f"the server's model has the language keys {join_names(keys)}; set policy.language_key to one of them"
        )
    return keys[0]


def _check_steps(name: str, modality: Modality, history: str) -> None:
    if len(modality.steps) > _MOST_STEPS or max(modality.steps) > 0:
        raise PolicyError(
            f"the server's model wants {name} at the steps {join_names(map(str, modality.steps[:8]))}; "
            f"allowed: at most {_MOST_STEPS}, none of them in the future"
        )
    if history == "none" and any(modality.steps):
        raise ContradictionError(
            f"the server's model sees {name} at the steps {join_names(map(str, modality.steps))} before the newest, "
            'policy.history = "none"; allowed: "repeat" or "nearest"'
        )


def _check_written(key: str, written: ActionFormat | None, settings: RequestSettings) -> None:
    """Check that the server's format of an action agrees with the deployment.

    Otherwise poses could be taken for joints, or changes for absolute targets. Raises ActionSpaceError.
    """
    if written is None:
        return
    orientation, mine = _ORIENTATIONS.get(written.format), settings.action_pose.orientation
    if orientation is not None and (settings.action_space != "eef" or mine != orientation):
        raise ActionSpaceError(
            f"the server's model writes action {key!r} as {written.format}; policy.action_space = "
            f'{settings.action_space!r}, policy.action_pose.orientation = {mine!r}; allowed: "eef" '
            f"and {orientation!r}, or the key in policy.ignored_actions"
        )
    if written.representation == "DELTA" and settings.action_mode == "absolute":
        raise ActionSpaceError(
            f"the server's model answers with changes for the action {key!r} (DELTA); policy.action_mode = 'absolute'; "
            'allowed: "delta" or "relative"'
        )


def _prefixed(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{name}.{key}": value for key, value in values.items()}


def _kind(value: object) -> str:
    return f"a {type(value).__name__}" + (f" of {len(value)}" if isinstance(value, list) else "")
