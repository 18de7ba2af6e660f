"""Source wrapper that adds the pictures of the deployment's own cameras to each observation of a transport."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from runtime.cameras.base import NOT_LIVE, Camera, CameraCondition, CameraHealth
from runtime.core.clock import Clock
from runtime.core.sentences import Pattern
from runtime.core.types import Observation
from runtime.ipc.messages import Event
from runtime.transports.base import Source

_BACK = Pattern("cameras.back", "camera {camera} ({source}) gives pictures after {seconds:.1f} s")
_ABSENT = Pattern("cameras.absent", "camera {camera} ({source}): {why}")
_PLAYS_VIDEO = Pattern(
    "cameras.plays_video",
    "camera {camera} plays the video {video}: it does not show what is there",
)


class SourceWithCameras(Source):
    """Wrapper of another source that adds the newest picture of each camera, with its own capture time.

    A camera without a new picture repeats its last one with the old capture time, so that its age is checked and
    recorded like that of any other camera. A camera without a first picture is missing from the observation.
    """

    def __init__(self, source: Source, cameras: Sequence[Camera], clock: Clock) -> None:
        self._source = source
        self._cameras = tuple(cameras)
        self._clock = clock
        self._said: dict[str, CameraHealth] = {}

    def connect(self) -> None:
        """Start the cameras without waiting for them, and connect the source."""
        for camera in self._cameras:
            camera.start()
        self._source.connect()

    def receive(self, timeout: float) -> Observation | None:
        observation = self._source.receive(timeout)
        return None if observation is None else self._add_images(observation)

    def _add_images(self, observation: Observation) -> Observation:
        pictures, captured = dict(observation.pictures), dict(observation.captured)
        # Our camera replaces a picture of the transport with the same key, even before its own first picture.
        for camera in self._cameras:
            pictures.pop(camera.key, None)
            captured.pop(camera.key, None)
            shot = camera.latest()
            if shot is not None:
                pictures[camera.key], captured[camera.key] = shot.picture, shot.captured
        return replace(observation, pictures=MappingProxyType(pictures), captured=MappingProxyType(captured))

    def begin_run(self) -> None:
        for camera in self._cameras:
            camera.begin_run()
        self._source.begin_run()

    def end_run(self) -> None:
        for camera in self._cameras:
            camera.end_run()
        self._source.end_run()

    def faults(self) -> dict[str, int]:
        """Return the faults of the source and of each camera."""
        counts = dict(self._source.faults())
        for camera in self._cameras:
            counts |= camera.faults()
        return counts

    def describe_fault(self, fault: str) -> str:
        return self._source.describe_fault(fault)

    def camera_health(self) -> dict[str, dict[str, Any]]:
        """Return the health of each camera, by camera key.

        The health is a map with "kind", "source", "condition", "since", "why", "losses" and "age". "since" is the time
        on our clock at which the condition began [s], and "why" is the reason for the condition. "age" is the age of
        the newest picture [s], None before the first.
        """
        return {camera.key: self._health_dict(camera) for camera in self._cameras}

    def pop_events(self) -> list[Event]:
        """Return the source's events, and one for each camera that was lost, ended, returned or cannot be opened."""
        events = self._source.pop_events()
        for camera in self._cameras:
            health, before = camera.health(), self._said.get(camera.key)
            if before is not None and (before.condition, before.why) == (health.condition, health.why):
                continue
            self._said[camera.key] = health
            if before is None and camera.kind == "file":
                events.append(self._warning(camera))
            event = self._event(camera, health, before)
            if event is not None:
                events.append(event)
        return events

    def _event(self, camera: Camera, health: CameraHealth, before: CameraHealth | None) -> Event | None:
        which = {"camera": camera.key, "source": camera.shown}
        if health.condition is CameraCondition.LIVE:
            if before is None or before.condition is CameraCondition.LIVE:
                return None
            away = health.since - before.since
            kind, text = "camera_back", _BACK(**which, seconds=away)
        elif health.condition is CameraCondition.OPENING:
            if not health.failed:
                return None
            kind, text = "camera_absent", _ABSENT(**which, why=health.why)
        else:
            kind = f"camera_{health.condition}"
            text = NOT_LIVE(**which, condition=health.condition, why=health.why)
        return Event(kind, text, self._clock.now(), data={"camera": camera.key, **self._health_dict(camera)})

    def _warning(self, camera: Camera) -> Event:
        """Return the event that warns that the camera plays a video file, so that the policy does not see the robot."""
        text = _PLAYS_VIDEO(camera=camera.key, video=camera.shown)
        return Event("camera_is_a_video", text, self._clock.now(), data={"camera": camera.key})

    def _health_dict(self, camera: Camera) -> dict[str, Any]:
        health, shot = camera.health(), camera.latest()
        return {
            "kind": camera.kind,
            "source": camera.shown,
            "condition": str(health.condition),
            "since": health.since,
            "why": health.why,
            "losses": health.losses,
            "age": None if shot is None else self._clock.now() - shot.captured,
        }

    def close(self) -> None:
        for camera in self._cameras:
            camera.request_stop()
        for camera in self._cameras:
            camera.close()
        self._source.close()
