"""Client of an EVA Web station that is served as a robot (`python -m runtime.clients.robot_server STATION`).

    with Station(url, program="my loop") as station:
        names = station.describe().joint_names
        station.begin("put the block on the plate")
        while True:
            observation = station.observe()
            station.act(my_policy(observation.joints, observation.pictures))

The station holds its limits, its e-stop and its recording over every row. When it ends the run, for whatever reason,
every further call raises StationError with the reason.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

PROTOCOL = 1
URL_VARIABLE = "EVAWEB_ROBOT_URL"
_BEGIN_S = 300.0  # a set-up drives to the start pose and waits for every camera
_ANSWER_S = 15.0
_LARGEST = 1 << 28  # [bytes] of an answer
# From version 15 on websockets connects through the proxy of the environment, which a robot is not behind.
_NO_PROXY: dict[str, Any] = {"proxy": None} if int(version("websockets").partition(".")[0]) >= 15 else {}


class StationError(RuntimeError):
    """Error that a station refuses a request.

    `is_over` means that its run has ended; `is_stopped` that it was stopped as a run usually is, by a person or by its
    limit of time, and that the station is ready for another.
    """

    def __init__(self, message: str, is_over: bool = False, is_stopped: bool = False) -> None:
        super().__init__(message)
        self.is_over = is_over
        self.is_stopped = is_stopped


@dataclass(frozen=True)
class LerobotFeature:
    """LeRobot's name of a joint, and its unit there: the joint's number is `scale` times LeRobot's, plus `offset`."""

    name: str
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class StationDescription:
    """Robot of a station: names, units, limits, speeds and home pose of its numbers [D], control rate [Hz].

    `cameras` has height and width of the pictures by camera. `has_bench` is True for a simulated bench, which a seed
    resets. `features` are LeRobot's names and units of the numbers, as the robot's description has them, else
    `GROUP.JOINT.pos` in the robot's own units.
    """

    station: str
    robot: str
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    velocity: tuple[float, ...]
    home: tuple[float, ...]
    gripper_dims: tuple[int, ...]
    rate: float
    cameras: Mapping[str, tuple[int, int]]
    tasks: tuple[str, ...]
    moves_robot: bool
    has_bench: bool
    features: tuple[LerobotFeature, ...]

    def to_lerobot(self, joints: np.ndarray) -> dict[str, float]:
        """Return the numbers of LeRobot for joints [D]."""
        pairs = zip(self.features, joints, strict=True)
        return {feature.name: (float(number) - feature.offset) / feature.scale for feature, number in pairs}

    def from_lerobot(self, numbers: Mapping[str, Any]) -> np.ndarray:
        """Return the joints float32 [D] for numbers of LeRobot. Raises: KeyError, with the names that are missing."""
        missing = [feature.name for feature in self.features if feature.name not in numbers]
        if missing:
            raise KeyError(f"the action lacks {', '.join(missing)}; it has {', '.join(numbers)}")
        joints = [feature.scale * float(numbers[feature.name]) + feature.offset for feature in self.features]
        return np.array(joints, np.float32)


@dataclass(frozen=True)
class Observation:
    """Observation of a station: measured joints float32 [D], newest command [D], pictures uint8 RGB [H, W, 3].

    `captured` has the capture times on the station's clock [s], of "joints" and by camera. `environment_state` is a
    benchmark's own observation vector, None without one.
    """

    step: int
    task: str
    joints: np.ndarray
    commanded: np.ndarray | None
    captured: Mapping[str, float]
    pictures: Mapping[str, np.ndarray]
    environment_state: np.ndarray | None = None


class Station:
    """Connection to a station's robot server, used by one thread; it connects with the first request.

    Args:
        url: Address that the robot server prints, with its token; "" for that in $EVAWEB_ROBOT_URL.
        program: Name of the program, for the station's records and messages.
    """

    def __init__(self, url: str = "", program: str = "a program") -> None:
        self._url = url or os.environ.get(URL_VARIABLE, "")
        if not self._url:
            raise StationError(
                f"no address of a station: give the url that its robot server prints, or ${URL_VARIABLE}"
            )
        if not self._url.startswith(("ws://", "wss://")):
            raise StationError(
                "the url of a station begins with ws:// or wss://, as its robot server prints it"
            )
        self._program = program
        self._has_begun = False
        self._connection: ClientConnection | None = None
        self._pictures: dict[str, np.ndarray] = {}

    def __enter__(self) -> Station:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_connected(self) -> bool:
        """Whether a connection is open."""
        return self._connection is not None

    def describe(self) -> StationDescription:
        """Return the station's robot; it needs no lease and moves nothing. Raises: StationError."""
        answer = self._request("describe", _ANSWER_S)
        if answer["protocol"] != PROTOCOL:
            raise StationError(
                f"the robot server speaks protocol {answer['protocol']}, this client {PROTOCOL}: install the client "
                "of the same version"
            )
        absent = [camera for camera, size in answer["cameras"].items() if size is None]
        if absent:
            raise StationError(
                f"{answer['station']} has no picture of {', '.join(absent)} yet (it is {answer['state']})"
            )
        cameras = {camera: (int(size[0]), int(size[1])) for camera, size in answer["cameras"].items()}
        names = ("joint_names", "units", "lower", "upper", "velocity", "home", "gripper_dims", "tasks")
        single = ("station", "robot", "rate", "moves_robot", "has_bench")
        facts: dict[str, Any] = {name: tuple(answer[name]) for name in names}
        facts |= {name: answer[name] for name in single}
        given = answer.get("lerobot") or [[f"{name}.pos"] for name in answer["joint_names"]]
        features = tuple(LerobotFeature(*feature) for feature in given)
        return StationDescription(**facts, cameras=cameras, features=features)

    def begin(
        self,
        task: str = "",
        duration_s: float | None = None,
        seed: int | None = None,
        driver: str = "policy",
    ) -> str:
        """Claim the station, **drive it to its start pose**, begin a run and return its episode ("" if not recorded).

        Args:
            task: Instruction; "" for that of the station.
            duration_s: Limit of the run [s]; None for that of the station.
            seed: Lays out a simulated bench; None draws one.
            driver: "policy", or "person" if a person drives through this program: the episode is a demonstration.

        Raises:
            StationError: The station refuses, for the reason in the message.
        """
        self._pictures = {}
        request = {"task": task, "duration_s": duration_s, "seed": seed, "driver": driver}
        answer = self._request("begin", _BEGIN_S, **request)
        self._has_begun = True
        return str(answer["episode"])

    def observe(self) -> Observation:
        """Return the newest observation, at most half a second old. Raises: StationError."""
        answer = self._request("observe", _ANSWER_S)
        self._pictures = {**self._pictures, **answer.pop("pictures")}
        return Observation(pictures=self._pictures, **answer)

    def act(self, row: np.ndarray) -> None:
        """Send targets [D] for the joints, in their units; they hold until the next row. Raises: StationError."""
        self._request("act", _ANSWER_S, row=np.ascontiguousarray(row, np.float32))

    def end(self) -> str:
        """Stop the run, wait until its episode is closed and return it. Raises: StationError."""
        self._has_begun = False
        return str(self._request("end", _BEGIN_S)["episode"])

    def watch(self) -> Mapping[str, np.ndarray]:
        """Return the newest joints float32 [D] of a station that others drive: `measured`, `commanded`, `planned`.

        Commanded and planned joints are NaN if there are none. Raises: StationError.
        """
        return self._request("watch", _ANSWER_S)

    def close(self) -> None:
        """End a run of this client, and close the connection. Safe to call twice."""
        if self._has_begun and self._connection is not None:
            with contextlib.suppress(StationError):  # the station ends it too when the connection has gone
                self.end()
        self._drop()

    def _drop(self) -> None:
        """Close the connection as it is, without another request."""
        connection, self._connection, self._has_begun = self._connection, None, False
        if connection is not None:
            connection.close()

    def _request(self, word: str, patience: float, **arguments: Any) -> dict[str, Any]:
        try:
            if self._connection is None:
                opening = connect(
                    self._url,
                    max_size=_LARGEST,
                    compression=None,
                    ping_interval=None,
                    open_timeout=10.0,
                    **_NO_PROXY,
                )
                self._connection = opening.__enter__()  # newer versions of websockets open it only then
            request = {"do": word, "program": self._program, **arguments}
            self._connection.send(msgpack.packb(request, default=_encode))
            answer = msgpack.unpackb(self._connection.recv(patience), object_hook=_decode)
        except (OSError, TimeoutError, WebSocketException, ValueError) as error:
            self._drop()  # an answer that comes later belongs to no other request
            place = self._url.partition("?")[0]
            text = (
                str(error).replace(self._url, place) or type(error).__name__
            )  # the token is for nobody's log
            raise StationError(f"{place}: {word}: {text}", is_over=True) from None
        except (
            BaseException
        ):  # an interrupted request leaves an answer, which the next one would take for its own
            self._drop()
            raise
        if "error" in answer:
            is_over, is_stopped = bool(answer.get("over")), bool(answer.get("stopped"))
            raise StationError(str(answer["error"]), is_over, is_stopped)
        return dict(answer)


def _encode(value: object) -> dict[bytes, Any]:
    if isinstance(value, np.ndarray):
        kind, shape = value.dtype.str, list(value.shape)
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": kind, b"shape": shape}
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _decode(fields: dict[Any, Any]) -> Any:
    if b"__ndarray__" in fields:
        return np.frombuffer(fields[b"data"], fields[b"dtype"]).reshape(fields[b"shape"])
    return fields
