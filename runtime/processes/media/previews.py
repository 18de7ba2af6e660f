"""JPEG previews of every camera on the bus."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import simplejpeg
import zmq

from runtime.core.types import Observation, UInt8
from runtime.ipc.bus import CAMERA_HIGH_WATER, Endpoints, Publisher
from runtime.station.spec import StationSpec


class Previews:
    """Shows each new picture small to who looks, at most `bus.preview_rate` times a second and camera.

    One that only stands in further observations is not shown again: who looks sees it grow old.
    """

    def __init__(self, spec: StationSpec) -> None:
        settings = spec.deployment.bus
        folder = spec.deployment.station_dir
        self._publisher = Publisher(zmq.Context.instance(), folder, "cameras", CAMERA_HIGH_WATER)
        self._period = 1.0 / settings.preview_rate if settings.preview_rate else float("inf")
        self._height = settings.preview_height
        self._due: dict[str, float] = {}
        self._shown: dict[str, float] = {}  # when each camera's last one was captured
        self._newest: Observation | None = None
        cv2.setNumThreads(1)  # the other cores belong to the rest of the family
        self._endpoints = Endpoints(folder)
        self._write_endpoints()

    def _write_endpoints(self) -> None:
        self._endpoints.write("media", {"cameras": self._publisher.endpoint})

    @property
    def socket(self) -> zmq.Socket[Any]:
        """Can be read when somebody begins to look, or no longer does."""
        socket: zmq.Socket[Any] = self._publisher.socket
        return socket

    def wanted(self) -> bool:
        """True if somebody looks; to be asked five times a second: looks whether they can connect."""
        if self._publisher.rebind_if_unreachable():
            self._write_endpoints()
        for topic in self._publisher.hear():  # who begins to look sees what there is
            self._due = {
                name: due for name, due in self._due.items() if not f"camera/{name}".startswith(topic)
            }
            self._shown.clear()
        return bool(self._publisher.topics)

    def __call__(self, observation: Observation) -> None:
        self._newest = observation
        self.wanted()
        for camera in observation.pictures:
            if not self._publisher.wanted(f"camera/{camera}"):
                continue
            captured = observation.captured.get(camera, observation.arrived)
            if observation.arrived < self._due.get(camera, 0.0) or captured == self._shown.get(camera):
                continue
            if (
                picture := observation.pictures.get(camera)
            ) is None:  # overwritten: the next one comes at once
                continue
            self._shown[camera] = captured
            # A little early counts, so that 15 of 30 pictures a second are shown and not 10.
            self._due[camera] = observation.arrived + 0.9 * self._period
            self._publisher.publish(
                f"camera/{camera}", simplejpeg.encode_jpeg(self._small(picture), quality=80)
            )

    def republish(self) -> None:
        """Show the newest of each camera once more: time stands still, and who begins to look now sees them too."""
        self._due.clear()
        self._shown.clear()
        if self._newest is not None:
            self(self._newest)

    def close(self) -> None:
        """Release the socket."""
        self._publisher.close()

    def _small(self, picture: UInt8) -> UInt8:
        """By a whole factor, each pixel the mean of those that it stands for."""
        factor = max(1, picture.shape[0] // self._height)
        size = (-(-picture.shape[1] // factor), -(-picture.shape[0] // factor))
        return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
