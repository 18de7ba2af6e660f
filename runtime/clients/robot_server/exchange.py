"""Exchange between the policy `external` of a station and the program that drives: newest observation, newest row."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from runtime.core import msgpack_arrays
from runtime.core.errors import CodecError
from runtime.core.types import Float32, UInt8
from runtime.ipc.endpoints import new_socket_path

log = logging.getLogger(__name__)
_TURN_MS = 100
_LOOKED_AT_S = 2.0  # pictures are passed on for this long after the program's last observation [s]


@dataclass(frozen=True, slots=True)
class LatestObservation:
    """Newest observation of the station, with the newest picture of each camera, RGB uint8 [H, W, 3].

    `arrived` is its arrival here on this clock [s], `captured` are capture times on the station's own clock [s], and
    `picture_times` those of `pictures`, which may be older: pictures are passed on only while they are looked at.
    """

    arrived: float
    step: int
    joints: Float32  # [D]
    captured: Mapping[str, float]
    task: str
    commanded: Float32 | None = None  # [D]
    environment_state: Any = None
    pictures: Mapping[str, UInt8] = field(default_factory=dict)
    picture_times: Mapping[str, float] = field(default_factory=dict)

    def has_newest_pictures(self, cameras: frozenset[str]) -> bool:
        """Return True if the pictures of these cameras are the newest that the station has."""
        return all(
            camera in self.pictures and self.picture_times[camera] == self.captured.get(camera)
            for camera in cameras
        )


class RowExchange:
    """Socket at which a policy `external` passes observations on and fetches rows; a thread answers at once."""

    def __init__(
        self,
        context: zmq.Context[Any],
        station_dir: Path,
        name: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        path = new_socket_path(station_dir, name)
        self.socket_path = str(path)
        self._clock = clock
        self._changed = threading.Condition()
        self._row: Float32 | None = None
        self._newest: LatestObservation | None = None
        self._looked = -float("inf")
        self._ended = threading.Event()
        self._path = path
        self._socket = context.socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.bind(f"ipc://{path}")
        path.chmod(0o600)
        self._thread = threading.Thread(target=self._serve, name="rows", daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Forget row and observations of an earlier run."""
        with self._changed:
            self._row, self._newest, self._looked = None, None, self._clock()

    def set_row(self, row: Float32 | None) -> None:
        """Set the row [D] that the next answers have; None leaves the robot at its command."""
        with self._changed:
            self._row = row

    def wait_for_observation(
        self, cameras: frozenset[str], newer_than: float, seconds: float
    ) -> LatestObservation | None:
        """Return the newest observation that has arrived after `newer_than` [s], with its pictures of all `cameras`.

        None if there is none within `seconds` [s].
        """

        def newest_observation() -> LatestObservation | None:
            newest = self._newest
            fits = newest is not None and newest.arrived > newer_than and newest.has_newest_pictures(cameras)
            return newest if fits else None

        with self._changed:
            self._looked = self._clock()
            return self._changed.wait_for(newest_observation, seconds)

    def close(self) -> None:
        """Stop answering; safe to call twice."""
        self._ended.set()
        self._thread.join()
        self._path.unlink(missing_ok=True)

    def _serve(self) -> None:
        try:
            while not self._ended.is_set():
                if self._socket.poll(_TURN_MS):
                    self._socket.send(msgpack_arrays.pack(self._answer(self._socket.recv())))
        finally:
            self._socket.close()

    def _answer(self, payload: bytes) -> dict[str, Any]:
        try:
            message = msgpack_arrays.unpack(payload)
            if message["do"] == "infer":
                self._store(message)
            elif message["do"] == "reset":
                self.set_row(None)
        except (CodecError, KeyError, TypeError, ValueError) as error:  # of another version of the policy
            log.exception("a request of the station cannot be used")
            return {"error": f"{type(error).__name__}: {error}"}
        with self._changed:
            return {"row": self._row, "pictures": self._clock() - self._looked < _LOOKED_AT_S}

    def _store(self, message: dict[str, Any]) -> None:
        with self._changed:
            before, times = (self._newest.pictures, self._newest.picture_times) if self._newest else ({}, {})
            pictures, captured = message["pictures"], message["captured"]
            commanded = message.get("commanded")
            self._newest = LatestObservation(
                arrived=self._clock(),
                step=int(message["step"]),
                joints=message["joints"],
                captured=captured,
                task=str(message["task"]),
                commanded=None if commanded is None else np.asarray(commanded, np.float32),
                environment_state=message.get("environment_state"),
                pictures={**before, **pictures},
                picture_times={**times, **{camera: captured[camera] for camera in pictures}},
            )
            self._changed.notify_all()
