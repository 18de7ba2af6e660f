"""Construction of LeRobot's devices from a table, as LeRobot's own programs do it.

LeRobot's environment runs this module.
"""

from __future__ import annotations

import copy
import dataclasses
import importlib
import pkgutil
import shlex
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

_PACKAGES = {"robot": "lerobot.robots", "teleoperator": "lerobot.teleoperators", "camera": "lerobot.cameras"}
_CONFIGS = {"robot": "RobotConfig", "teleoperator": "TeleoperatorConfig", "camera": "CameraConfig"}
_THIRD_PARTY = ("lerobot_robot_", "lerobot_teleoperator_", "lerobot_camera_")
_NAMING = ("type", "port", "id", "calibration_dir")  # options that name a device
_OPTIONS = {"robot": "robot", "teleoperator": "teleop"}  # of LeRobot's commands


LOST = 3  # exit code of a host whose device is lost, for a reason that it has reported


class DeviceLost(Exception):
    """Error that a device cannot be connected, or is lost; the message says why."""


class DeviceRefused(Exception):
    """Error that a device cannot be made as the table says; the message says what is allowed."""


def make_device(role: str, table: Mapping[str, Any]) -> Any:
    """Return the device that `table` describes: `type`, and fields of its configuration in LeRobot.

    Raises:
        DeviceRefused: There is no such type or field, or the device's own code refuses them.
    """
    import draccus  # type: ignore[import-not-found]
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    absent = [*_import_types(role), *_import_third_party()]
    _require_rgb("device", table)
    base = getattr(importlib.import_module(_PACKAGES[role]), _CONFIGS[role])
    kind, known = table.get("type"), sorted(base.get_known_choices())
    if kind not in known:
        hint = f"; cannot be imported here: {'; '.join(absent)}" if absent else ""
        raise DeviceRefused(f"device.type = {kind!r}; allowed: {', '.join(known)}{hint}")
    fields = [field.name for field in dataclasses.fields(base.get_choice_class(kind)) if field.init]
    if unknown := [key for key in table if key not in ("type", *fields)]:
        raise DeviceRefused(f"device.{unknown[0]}: unknown key of {kind}; allowed: {', '.join(fields)}")
    try:
        config = draccus.decode(base, copy.deepcopy(dict(table)))
    except Exception as error:
        raise DeviceRefused(f"device of {kind}: {describe_error(error)}") from error
    try:
        return _make(role, config)
    except Exception as error:
        # LeRobot's own sentence around an error repeats the configuration, which may hold a password.
        raise DeviceRefused(f"{kind} cannot be made: {describe_error(error.__cause__ or error)}") from error


def require_features(device: Any, joints: Sequence[str], images: Sequence[str]) -> None:
    """Raise DeviceRefused unless the robot observes these joints and pictures, and has these joints as its action."""
    observed, commanded = device.observation_features, device.action_features
    numbers = [name for name, kind in observed.items() if not isinstance(kind, tuple)]
    pictures = [name for name, kind in observed.items() if isinstance(kind, tuple) and kind[-1] == 3]
    for what, given, allowed in (
        ("joints: observation features", joints, numbers),
        ("joints: action features", joints, list(commanded)),
        ("cameras: pictures", images, pictures),
    ):
        if unknown := [name for name in given if name not in allowed]:
            raise DeviceRefused(
                f"{what} {', '.join(unknown)} do not exist; the device has {', '.join(allowed) or 'none'}"
            )
    if twice := [name for name, count in Counter(joints).items() if count > 1]:
        raise DeviceRefused(f"joints: more than one has the feature {', '.join(twice)}; allowed: one each")
    if left := [name for name in commanded if name not in joints]:
        raise DeviceRefused(f"joints: the device's action needs {', '.join(left)} too, which no joint has")


def require_degrees(device: Any, joints: Sequence[str]) -> None:
    """Raise DeviceRefused if the device says itself that these joints are not in degrees.

    It says so by `use_degrees` of its configuration, or by the modes of the motors on its bus.
    """
    whole = getattr(getattr(device, "config", None), "use_degrees", True) is False
    motors = getattr(getattr(device, "bus", None), "motors", None) or {}
    modes = {f"{name}.pos": getattr(motor, "norm_mode", None) for name, motor in motors.items()}
    if others := [
        name for name in joints if whole or getattr(modes.get(name), "name", "DEGREES") != "DEGREES"
    ]:
        raise DeviceRefused(
            f'joints: {", ".join(others)} have unit = "degrees", which the device does not use; allowed: '
            "device.use_degrees = true, if it has that, or theirs and ours for each of these joints"
        )


def require_action(device: Any, joints: Sequence[str]) -> None:
    """Raise DeviceRefused unless the teleoperator gives these joints."""
    if unknown := [name for name in joints if name not in device.action_features]:
        raise DeviceRefused(
            f"joints: {', '.join(unknown)} do not exist; the device has {', '.join(device.action_features)}"
        )


def calibration_command(role: str, table: Mapping[str, Any]) -> str:
    """Return LeRobot's command that calibrates the device; of its configuration only what names the device.

    Others may be secrets, and this is shown to everybody.
    """
    options = [f"--{_OPTIONS[role]}.{key}={table[key]}" for key in _NAMING if key in table]
    return shlex.join([sys.executable, "-m", "lerobot.scripts.lerobot_calibrate", *options])


def _import_types(role: str) -> list[str]:
    """Import all types of LeRobot itself; return the packages that lack something here."""
    absent = []
    for package in {_PACKAGES[role], _PACKAGES["camera"]}:
        for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
            if not module.ispkg:
                continue
            try:
                importlib.import_module(f"{package}.{module.name}")
            except Exception as error:
                absent.append(f"{module.name} ({describe_error(error)})")
    return absent


def _import_third_party() -> list[str]:
    """Return the packages of others that cannot be imported here; LeRobot only logs that."""
    absent = []
    for module in pkgutil.iter_modules():
        if module.name.startswith(_THIRD_PARTY):
            try:
                importlib.import_module(module.name)
            except Exception as error:
                absent.append(f"{module.name} ({describe_error(error)})")
    return absent


def _require_rgb(key: str, table: Mapping[str, Any]) -> None:
    """Raise DeviceRefused if a camera in the table gives another order of colours: pictures are passed on as RGB."""
    for name, value in table.items():
        if isinstance(value, Mapping):
            _require_rgb(f"{key}.{name}", value)
        elif name == "color_mode" and str(value).lower() != "rgb":
            raise DeviceRefused(f"{key}.{name} = {value!r}; allowed: 'rgb'")


def _make(role: str, config: Any) -> Any:
    if role == "camera":
        from lerobot.cameras import make_cameras_from_configs

        return make_cameras_from_configs({"camera": config})["camera"]
    if role == "robot":
        from lerobot.robots import make_robot_from_config

        return make_robot_from_config(config)
    from lerobot.teleoperators import make_teleoperator_from_config

    return make_teleoperator_from_config(config)


def describe_error(error: BaseException) -> str:
    """Return an error of LeRobot's code as one line."""
    return f"{type(error).__name__}: {error}".replace("\n", " ")[:300]
