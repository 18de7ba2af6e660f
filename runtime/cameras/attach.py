"""Construction of cameras from a deployment's `[cameras.KEY]` tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from runtime.cameras.base import Address, Camera, CameraSettings
from runtime.cameras.live_camera import LiveCamera
from runtime.cameras.source_with_cameras import SourceWithCameras
from runtime.core.clock import Clock, VirtualClock
from runtime.core.errors import ConfigurationError, SetupError
from runtime.core.plugins import variants
from runtime.transports.base import Source

if TYPE_CHECKING:
    from robots import Robot


def check(cameras: Mapping[str, Any], robot: Robot) -> None:
    """Check that each table belongs to a camera of the robot and that its password is set.

    Raises ConfigurationError.
    """
    keys = [camera.key for camera in robot.cameras]
    for key in cameras:
        if key not in keys:
            raise ConfigurationError(
                f"cameras.{key}: {robot.name} has no such camera; allowed: {', '.join(keys) or 'none'}"
            )
        _address(key, cameras[key])


def attach_cameras(source: Source, cameras: Mapping[str, Any], clock: Clock) -> Source:
    """Return `source` with these cameras added; `source` itself if there are none.

    Raises SetupError for a live camera with a virtual clock, with which only files can be played.
    """
    if not cameras:
        return source
    virtual = isinstance(clock, VirtualClock)
    opened = [_camera(key, settings, clock, virtual) for key, settings in cameras.items()]
    return SourceWithCameras(source, opened, clock)


def _camera(key: str, settings: CameraSettings, clock: Clock, virtual: bool) -> Camera:
    kind = str(settings.kind)  # type: ignore[attr-defined]  # every variant declares it
    if kind == "file":
        from runtime.cameras.file import Config
        from runtime.cameras.file_player import FileCamera

        assert isinstance(settings, Config)
        return FileCamera(key, settings, clock, threaded=not virtual)
    if virtual:
        raise SetupError(
            f"cameras.{key}: kind {kind!r} runs in real time, and lockstep has a clock of its own; allowed "
            "there: 'file'"
        )
    if kind == "lerobot":
        from runtime.cameras.lerobot import Config as LerobotConfig
        from runtime.cameras.lerobot_camera import LerobotCamera

        assert isinstance(settings, LerobotConfig)
        return LerobotCamera(key, settings, clock)
    return LiveCamera(key, kind, settings, _address(key, settings), clock)


def _address(key: str, settings: Any) -> Address:
    try:
        address: Address = variants("runtime.cameras")[settings.kind].address(settings)
    except ConfigurationError as error:
        raise ConfigurationError(f"cameras.{key}: {error}") from None
    return address
