"""From a deployment's `[cameras.KEY]` tables to cameras on a source."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from runtime.cameras.attached import SourceWithCameras
from runtime.cameras.base import Address, Camera, CameraSettings
from runtime.cameras.live import LiveCamera
from runtime.core.clock import Clock, VirtualClock
from runtime.core.errors import ConfigurationError, SetupError
from runtime.core.plugins import variants
from runtime.transports.base import Source

if TYPE_CHECKING:
    from robots import Robot


def check(cameras: Mapping[str, Any], robot: Robot) -> None:
    """Raise ConfigurationError where a table is of no camera of the robot, or its password is not there."""
    known = [camera.key for camera in robot.cameras]
    for key in cameras:
        if key not in known:
            raise ConfigurationError(
                f"cameras.{key}: {robot.name} has no such camera; allowed: {', '.join(known) or 'none'}"
            )
        _address(key, cameras[key])


def attach_cameras(source: Source, cameras: Mapping[str, Any], clock: Clock) -> Source:
    """`source` with these cameras; itself where there are none.

    On a virtual clock files alone can be played: SetupError for a camera that goes on by itself.
    """
    if not cameras:
        return source
    virtual = isinstance(clock, VirtualClock)
    made = [_camera(key, settings, clock, virtual) for key, settings in cameras.items()]
    return SourceWithCameras(source, made, clock)


def _camera(key: str, settings: CameraSettings, clock: Clock, virtual: bool) -> Camera:
    kind = str(settings.kind)  # type: ignore[attr-defined]  # every variant has one
    if kind == "file":
        from runtime.cameras.file import Config
        from runtime.cameras.playing import FileCamera

        assert isinstance(settings, Config)
        return FileCamera(key, settings, clock, threaded=not virtual)
    if virtual:
        raise SetupError(
            f"cameras.{key}: kind {kind!r} goes on by itself, and lockstep has no real time; allowed there: 'file'"
        )
    return LiveCamera(key, kind, settings, _address(key, settings), clock)


def _address(key: str, settings: Any) -> Address:
    try:
        address: Address = variants("runtime.cameras")[settings.kind].address(settings)
    except ConfigurationError as error:
        raise ConfigurationError(f"cameras.{key}: {error}") from None
    return address
