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
    """Publisher of new pictures, scaled down, at most `bus.preview_rate` times per second and camera.

    A picture that is merely repeated in later observations is not published again, so viewers see its age grow.
    """

    def __init__(self, spec: StationSpec) -> None:
        settings = spec.deployment.bus
        folder = spec.deployment.station_dir
        self._publisher = Publisher(zmq.Context.instance(), folder, "cameras", CAMERA_HIGH_WATER)
        self._period = 1.0 / settings.preview_rate if settings.preview_rate else float("inf")
        self._height = settings.preview_height
        self._due: dict[str, float] = {}
        self._shown: dict[str, float] = {}  # capture time of each camera's last preview
        self._newest: Observation | None = None
        cv2.setNumThreads(1)  # other cores belong to the other station processes
        self._endpoints = Endpoints(folder)
        self._write_endpoints()

    def _write_endpoints(self) -> None:
        self._endpoints.write("media", {"cameras": self._publisher.endpoint})

    @property
    def socket(self) -> zmq.Socket[Any]:
        """Socket that becomes readable when the set of viewers changes."""
        socket: zmq.Socket[Any] = self._publisher.socket
        return socket

    def is_requested(self) -> bool:
        """Return True if there are viewers. Call it five times a second: it also repairs an unreachable socket."""
        if self._publisher.rebind_if_unreachable():
            self._write_endpoints()
        for topic in self._publisher.poll_subscriptions():  # a new viewer gets the newest pictures
            self._due = {
                name: due for name, due in self._due.items() if not f"camera/{name}".startswith(topic)
            }
            self._shown.clear()
        return bool(self._publisher.topics)

    def __call__(self, observation: Observation) -> None:
        self._newest = observation
        self.is_requested()
        for camera in observation.pictures:
            if not self._publisher.has_subscriber(f"camera/{camera}"):
                continue
            captured = observation.captured.get(camera, observation.arrived)
            if observation.arrived < self._due.get(camera, 0.0) or captured == self._shown.get(camera):
                continue
            if (
                picture := observation.pictures.get(camera)
            ) is None:  # overwritten; the next picture follows soon
                continue
            self._shown[camera] = captured
            # Slightly early, so that 15 of 30 pictures per second are shown and not 10.
            self._due[camera] = observation.arrived + 0.9 * self._period
            self._publisher.publish(
                f"camera/{camera}", simplejpeg.encode_jpeg(self._small(picture), quality=80)
            )

    def republish(self) -> None:
        """Publish the newest pictures again, because time is paused and new viewers would receive none."""
        self._due.clear()
        self._shown.clear()
        if self._newest is not None:
            self(self._newest)

    def close(self) -> None:
        """Release the socket."""
        self._publisher.close()

    def _small(self, picture: UInt8) -> UInt8:
        """Scale down by a whole factor; each pixel is the mean of those that it replaces."""
        factor = max(1, picture.shape[0] // self._height)
        size = (-(-picture.shape[1] // factor), -(-picture.shape[0] // factor))
        return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
