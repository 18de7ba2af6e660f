"""A host of a LeRobot device: what it accepts, when its device is lost, and which pictures have a known age."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import robots
from runtime.core.errors import SetupError
from runtime.lerobot import host, roles
from runtime.lerobot.devices import (
    DeviceLost,
    DeviceRefused,
    _require_rgb,
    calibration_command,
    require_degrees,
)
from runtime.lerobot.features import JointFeature, JointMap, UnusableValue
from runtime.lerobot.host import Host
from runtime.lerobot.roles import CameraRole, HostSettings, Role

TABLE = {"role": "robot", "device": {"type": "arm"}, "observations": "ipc://o", "commands": "ipc://c"}
SETTINGS = HostSettings("camera", {}, "inproc://host")


class Clock:
    """A clock that only its test moves on."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


class Scripted(Role):
    """A role whose steps are `answers`: seconds that it takes, and what it then does; it stops after the last."""

    def __init__(self, clock: Clock, stop: threading.Event, answers: list[tuple[float, Any]]) -> None:
        self._clock, self._stop, self._answers = clock, stop, answers

    def require(self, device: Any) -> None:
        """Accept any device."""

    def step(self, device: Any) -> bool:
        seconds, what = self._answers.pop(0)
        self._clock.now += seconds
        if not self._answers:
            self._stop.set()
        if isinstance(what, Exception):
            raise what
        return bool(what)

    def close(self) -> None:
        """Do nothing."""


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(host, "time", made)
    monkeypatch.setattr(roles, "time", made)
    monkeypatch.setattr(host, "_PAUSE_S", 0.0)
    return made


def read(clock: Clock, *answers: tuple[float, Any]) -> list[dict[str, Any]]:
    """The reports while a device gives these answers."""
    reports: list[Any] = []
    stop = threading.Event()
    Host(SETTINGS, reports.append, stop)._read(None, Scripted(clock, stop, list(answers)))
    return reports


ERROR = ConnectionError("no status packet")


@pytest.mark.parametrize(
    "answers",
    [
        [(0.1, True), (3.0, ERROR), (0.1, True)],
        [(0.1, True), (1.0, ERROR), (1.0, ERROR), (0.1, True), (1.0, ERROR), (1.0, ERROR), (0.1, True)],
        [(0.1, ERROR)] * 5 + [(0.1, True)],
        [(0.1, True), *[(0.2, UnusableValue("not_finite", "pan is nan"))] * 20, (0.1, True)],
        [(0.1, True), *[(0.2, False)] * 20, (0.1, True)],
    ],
    ids=["one late error", "two and two", "a short burst", "values", "no pictures for four seconds"],
)
def test_a_device_that_answers_again_is_not_lost(clock: Clock, answers: list[tuple[float, Any]]) -> None:
    assert [report for report in read(clock, *answers) if "problem" in report] == [{"problem": ""}]


@pytest.mark.parametrize(
    ("answers", "error", "why"),
    [
        ([(0.1, True), (0.3, ERROR), (0.3, ERROR), (0.3, ERROR), (0.1, True)], ConnectionError, "no status"),
        ([(0.1, True), *[(0.2, False)] * 40, (0.1, True)], DeviceLost, "given nothing for 5 s"),
        ([*[(0.2, False)] * 40, (0.1, True)], DeviceLost, "given nothing for 5 s"),
    ],
    ids=["errors", "no more pictures", "never a picture"],
)
def test_a_device_that_gives_nothing_is_lost(
    clock: Clock, answers: list[tuple[float, Any]], error: type[Exception], why: str
) -> None:
    with pytest.raises(error, match=why):
        read(clock, *answers)


def test_a_camera_is_connected_with_its_first_picture(clock: Clock) -> None:
    assert read(clock, (0.2, False), (0.2, False)) == []


def test_pictures_that_may_have_waited_are_left_out(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    published: list[tuple[float, int]] = []

    def publish(socket: object, message: Any) -> None:
        published.append((message["t"], int(message["image"][0, 0, 0])))

    monkeypatch.setattr(roles, "_publish", publish)
    monkeypatch.setattr(roles, "bound", lambda *_: SimpleNamespace(close=lambda linger: None))
    role = CameraRole(SETTINGS)
    number = 0

    def read_picture(seconds: float) -> Callable[..., Any]:
        def async_read(timeout_ms: float) -> np.ndarray:
            nonlocal number
            clock.now += seconds
            number += 1
            return np.full((2, 2, 3), number, np.uint8)

        return async_read

    def take(count: int, seconds: float) -> None:
        for _ in range(count):
            role.step(SimpleNamespace(async_read=read_picture(seconds)))

    role.require(SimpleNamespace(fps=30))
    take(7, 0.03)
    assert published == [(pytest.approx(100.15), 6), (pytest.approx(100.18), 7)]
    published.clear()
    take(1, 2.0)  # it was suspended, and the driver's queue is full
    take(4, 0.001)
    assert published == []
    take(1, 0.03)
    assert published == [(pytest.approx(102.214), 13)]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"role": ["robot"]}, r"role = \['robot'\]; allowed: robot, teleoperator, camera"),
        ({"device": "arm"}, "device = 'arm'; allowed: a table with its `type`"),
        ({"observations": 5555}, "observations = 5555; allowed: an endpoint"),
        ({"commands": ""}, "commands is missing"),
        ({"cameras": {"front": 1}}, "cameras = {'front': 1}; allowed: observation key = picture"),
        *[
            ({"rate": rate}, "rate = .*; allowed: above 0, up to 1000 Hz")
            for rate in (0, -5.0, "30", math.inf, True)
        ],
        *[
            ({"deadline_s": late}, "deadline_s = .*; allowed: above 0, up to 5 s")
            for late in (0.0, "0.3", math.nan)
        ],
        ({"insecure_link": 1}, "insecure_link = 1; allowed: true, false"),
        ({"speed": 1}, "'speed'; allowed: role, device"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_with_its_name(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(DeviceRefused, match=sentence):
        HostSettings.from_table(TABLE | changes)


@pytest.mark.parametrize(
    ("joints", "sentence"),
    [
        ([], r"joints = \[\]; allowed: a table per group"),
        ({"arm": {"pan": "pan.pos"}}, "joint arm.pan: 'pan.pos'; allowed: feature"),
        ({"arm": {"pan": {"feature": "pan.pos", "turn": 1}}}, "joint arm.pan: .*; allowed: feature"),
        (
            {"arm": {"pan": {"feature": "p", "theirs": [0, 1]}}},
            "theirs = .*, ours = None, .* both theirs and ours",
        ),
        ({"arm": {"pan": {"feature": "p", "theirs": [0, 1], "ours": [1, 1]}}}, "two different numbers each"),
        (
            {"arm": {"pan": {"feature": "p", "unit": "degrees", "theirs": [0, 1], "ours": [0, 2]}}},
            "unit = 'degrees'; allowed: unit, or both",
        ),
    ],
)
def test_a_joint_that_cannot_be_is_refused_with_its_name(joints: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        JointMap.from_tables(joints)


@pytest.mark.parametrize("value", [1e39, -math.inf, math.nan, "much", None])
def test_a_number_that_no_joint_has_is_not_passed_on(value: object) -> None:
    with pytest.raises(UnusableValue, match="p is"):
        JointFeature.from_table("arm.pan", {"feature": "p"}).read({"p": value})


def test_joints_in_degrees_are_refused_where_the_device_has_other_numbers() -> None:
    joints = JointMap.from_tables(
        {"arm": {"pan": {"feature": "pan.pos", "unit": "degrees"}, "grip": {"feature": "gripper.pos"}}}
    )
    assert joints.in_degrees == ("pan.pos",)
    assert joints.tolerance.tolist() == [0.15, math.inf]
    require_degrees(SimpleNamespace(config=SimpleNamespace(use_degrees=True)), joints.in_degrees)
    require_degrees(SimpleNamespace(), joints.in_degrees)
    motor = SimpleNamespace(norm_mode=SimpleNamespace(name="RANGE_M100_100"))
    for device in (
        SimpleNamespace(config=SimpleNamespace(use_degrees=False)),
        SimpleNamespace(bus=SimpleNamespace(motors={"pan": motor})),
    ):
        with pytest.raises(
            DeviceRefused, match=r"pan.pos have unit = \"degrees\", which the device does not use"
        ):
            require_degrees(device, joints.in_degrees)


def test_a_camera_with_another_order_of_colours_is_refused() -> None:
    table = {"type": "arm", "cameras": {"wrist": {"type": "opencv", "color_mode": "bgr"}}}
    with pytest.raises(DeviceRefused, match=r"device.cameras.wrist.color_mode = 'bgr'; allowed: 'rgb'"):
        _require_rgb("device", table)
    table["cameras"]["wrist"]["color_mode"] = "RGB"  # type: ignore[index]
    _require_rgb("device", table)


def test_what_calibrates_a_device_shows_no_secret_of_it() -> None:
    command = calibration_command(
        "robot", {"type": "arm", "port": "/dev/a b", "id": "1", "password": "hunter2"}
    )
    assert command.endswith("--robot.type=arm '--robot.port=/dev/a b' --robot.id=1")


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"port": "/dev/null"}, {"left_arm": {"port": "/dev/null"}, "right_arm": {"port": "/dev/zero"}}),
        ({"left_arm_port": "/dev/null"}, {"port": "/dev/../dev/null", "id": "2"}),
        ({"cameras": {"wrist": {"index_or_path": 63}}}, {"index_or_path": "/dev/video63", "fps": 15}),
        ({"remote_ip": "192.0.2.1", "id": "1"}, {"remote_ip": "192.0.2.1", "id": "2"}),
        ({"type": "of this test"}, {"type": "of this test"}),
    ],
)
def test_no_two_processes_have_one_device(
    first: dict[str, Any], second: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    locks = host.lock_device(first)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with pytest.raises(SetupError, match="another process has the device"):
        host.lock_device(second)
    for lock in locks:
        lock.close()
    for lock in host.lock_device(second):
        lock.close()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (None, "No such file"),
        ("role = ", "Invalid value"),
        ('role = "robot"', "missing 2 required"),
        (
            'role = "robot"\ndevice = { type = "arm" }\nobservations = "tcp://0.0.0.0:1"\ncommands = "x://y"\nrate = 0',
            "rate = 0",
        ),
    ],
)
def test_a_file_that_cannot_be_is_refused_in_a_sentence(
    tmp_path: Path, text: str | None, sentence: str
) -> None:
    file = tmp_path / "node.toml"
    if text is not None:
        file.write_text(text)
    line = [sys.executable, "-m", "runtime.lerobot.host", str(file)]
    done = subprocess.run(
        line, capture_output=True, text=True, check=False, cwd=Path(robots.__file__).parents[1]
    )
    assert (done.returncode, sentence in done.stderr, "Traceback" in done.stderr) == (2, True, False), (
        done.stderr
    )
