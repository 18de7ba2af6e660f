"""Reading of a LeRobot camera's pictures from the process that has the device."""

from __future__ import annotations

import time

import numpy as np
import zmq

from runtime.cameras import lerobot
from runtime.cameras.base import CameraError
from runtime.cameras.live_camera import LiveCamera
from runtime.cameras.video_stream import DecodedFrame
from runtime.core import msgpack_arrays
from runtime.core.clock import Clock
from runtime.core.errors import CodecError
from runtime.lerobot.process import HostEndpoints, HostProcess
from runtime.transports import node_link

_LIMIT = 64 * 1024 * 1024  # [bytes] of a message
_WAKE_S = 0.1


class LerobotCamera(LiveCamera):
    """Camera that owns the device's process, which connects the device again when it is lost."""

    def __init__(self, key: str, settings: lerobot.Config, clock: Clock) -> None:
        super().__init__(key, settings.kind, settings, lerobot.address(settings), clock)
        endpoints = HostEndpoints.of_process(key)
        self._endpoint = endpoints.observations
        self._host = HostProcess(settings.python, endpoints, {"role": "camera", "device": settings.device})

    def start(self) -> None:
        self._host.start()
        super().start()

    def faults(self) -> dict[str, int]:
        """Return the number of readings that the process did not pass on as `camera_REASON_<key>`."""
        return {f"camera_{fault}_{self.key}": count for fault, count in self._host.faults().items()}

    def request_stop(self) -> None:
        super().request_stop()
        self._host.request_stop()

    def close(self) -> None:
        super().close()
        self._host.stop()

    def _open_stream(self) -> LerobotStream:
        return LerobotStream(self._endpoint, self._settings.open_s, self._settings.read_s, self._host)

    def _captured(self, frame: DecodedFrame, arrived: float) -> float:
        """Return the frame's stamp itself, because both processes have the same clock."""
        return arrived if frame.stamp is None else min(frame.stamp, arrived)


class LerobotStream:
    """Socket that receives the newest picture of the process."""

    def __init__(self, endpoint: str, open_s: float, read_s: float, host: HostProcess) -> None:
        self._open_s, self._read_s, self._host = open_s, read_s, host
        options: dict[int, int | bytes] = {zmq.CONFLATE: 1, zmq.MAXMSGSIZE: _LIMIT, zmq.SUBSCRIBE: b""}
        self._socket = node_link.open_socket(zmq.SUB, endpoint, options)

    def read(self) -> DecodedFrame:
        """Return the next picture. Raises CameraError if there is none in time."""
        begun = time.monotonic()
        while not self._socket.poll(int(1000 * _WAKE_S)):
            patience = self._open_s if self._host.is_starting else self._read_s
            if time.monotonic() - begun > patience:
                why = f": {self._host.problem}" if self._host.problem else ""
                raise CameraError(f"mute: it sent no picture within {patience:g} s{why}")
        try:
            message = msgpack_arrays.unpack(self._socket.recv(), _LIMIT)
        except CodecError as error:
            raise CameraError(str(error)) from error
        image, stamp = message["image"], message["t"]
        return DecodedFrame(np.asarray(image, np.uint8), float(stamp))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
