"""A package `lerobot` without torch that follows LeRobot's published contract, and an environment that has it.

Its devices obey a file: the words of `faults.txt` in their folder say what goes wrong, and what they are commanded is
in `actions.jsonl`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from textwrap import dedent

_FILES = {
    "draccus/__init__.py": """
        class Registry:
            @classmethod
            def register_subclass(cls, name):
                def add(choice):
                    cls.choices[name] = choice
                    return choice
                return add
            @classmethod
            def get_known_choices(cls):
                return dict(cls.choices)
            @classmethod
            def get_choice_class(cls, name):
                return cls.choices[name]
        def decode(base, table):
            return base.choices[table.pop("type")](**table)
    """,
    "lerobot/__init__.py": "",
    "lerobot/utils/__init__.py": "",
    "lerobot/utils/import_utils.py": "def register_third_party_plugins(): import lerobot_robot_third",
    "lerobot_robot_third.py": """
        from dataclasses import dataclass
        from lerobot.robots import RobotConfig
        @RobotConfig.register_subclass("third")
        @dataclass
        class ThirdConfig(RobotConfig):
            pass
    """,
    "lerobot/robots/__init__.py": """
        from dataclasses import dataclass
        import draccus
        @dataclass(kw_only=True)
        class RobotConfig(draccus.Registry):
            choices = {}
            id: str | None = None
        def make_robot_from_config(config):
            from lerobot.robots.arm import Arm
            return Arm(config)
    """,
    "lerobot/robots/broken/__init__.py": "import no_such_driver",
    "lerobot/robots/arm/__init__.py": """
        from dataclasses import dataclass, field
        from lerobot.robots import RobotConfig
        from lerobot.device import Device
        @RobotConfig.register_subclass("arm")
        @dataclass(kw_only=True)
        class ArmConfig(RobotConfig):
            folder: str
            port: str | None = None
        class Arm(Device):
            observation_features = {"pan.pos": float, "grip.pos": float, "front": (8, 8, 3)}
            action_features = {"pan.pos": float, "grip.pos": float}
            def get_observation(self):
                values = self.read()
                size = 4 if self.has("size") else 8
                return values | {"front": numpy.full((size, size, 3), self.count % 256, numpy.uint8)}
            def send_action(self, action):
                assert set(action) == set(self.action_features), action
                self.write(action)
                return action
        import numpy
    """,
    "lerobot/teleoperators/__init__.py": """
        from dataclasses import dataclass
        import draccus
        @dataclass(kw_only=True)
        class TeleoperatorConfig(draccus.Registry):
            choices = {}
            id: str | None = None
        def make_teleoperator_from_config(config):
            from lerobot.teleoperators.handle import Handle
            return Handle(config)
    """,
    "lerobot/teleoperators/handle/__init__.py": """
        from dataclasses import dataclass
        from lerobot.device import Device
        from lerobot.teleoperators import TeleoperatorConfig
        @TeleoperatorConfig.register_subclass("handle")
        @dataclass(kw_only=True)
        class HandleConfig(TeleoperatorConfig):
            folder: str
        class Handle(Device):
            action_features = {"pan.pos": float, "grip.pos": float}
            feedback_features = {}
            def get_action(self):
                return self.read()
    """,
    "lerobot/cameras/__init__.py": """
        from dataclasses import dataclass
        import draccus
        @dataclass(kw_only=True)
        class CameraConfig(draccus.Registry):
            choices = {}
            fps: int | None = None
        def make_cameras_from_configs(configs):
            from lerobot.cameras.eye import Eye
            return {key: Eye(config) for key, config in configs.items()}
    """,
    "lerobot/cameras/eye/__init__.py": """
        import time
        from dataclasses import dataclass
        import numpy
        from lerobot.cameras import CameraConfig
        from lerobot.device import Device
        @CameraConfig.register_subclass("eye")
        @dataclass(kw_only=True)
        class EyeConfig(CameraConfig):
            folder: str
        class Eye(Device):
            def connect(self, warmup=True):
                super().connect(False)
            def async_read(self, timeout_ms=200):
                time.sleep(0.01)
                self.read()
                if self.has("unseen"):
                    raise TimeoutError("no new frame")
                size = 16 if self.has("size") else 8
                return numpy.full((size, 8, 3), (250, 10, 10), numpy.uint8)
    """,
    "lerobot/device.py": """
        import json, os, time
        from pathlib import Path
        class Device:
            def __init__(self, config):
                self.folder, self.is_connected, self.count = Path(config.folder), False, 0
                print("a driver prints on standard output")
            def has(self, word):
                return word in (self.folder / "faults.txt").read_text().split()
            @property
            def is_calibrated(self):
                return not self.has("uncalibrated")
            def connect(self, calibrate=True):
                assert not calibrate and not self.is_connected
                if self.has("unplugged"):
                    raise ConnectionError("no such port")
                if self.has("asks"):
                    input("press enter when the arm is in its middle ")
                self.is_connected = True
                self.note({"connected": os.getpid()})
                if self.has("forks"):
                    forked = os.fork()
                    if not forked:
                        time.sleep(600)
                    self.note({"forked": forked})
            def disconnect(self):
                self.is_connected = False
                self.note({"disconnected": os.getpid()})
            def read(self):
                self.count += 1
                if self.has("raises") or (self.has("once") and self.count % 5 == 0):
                    raise ConnectionError("no status packet")
                if self.has("late") and self.count % 5 == 0:
                    time.sleep(0.6)
                    raise ConnectionError("no status packet in time")
                if self.has("dies"):
                    os._exit(3)
                while self.has("hangs"):
                    (self.folder / "hung").touch()
                    time.sleep(0.01)
                values = {"pan.pos": 90.0, "grip.pos": 100.0}
                if self.has("nan"):
                    values["pan.pos"] = float("nan")
                if self.has("lacks"):
                    del values["grip.pos"]
                return values
            def write(self, action):
                if self.has("refuses"):
                    raise ValueError("goal out of range")
                self.note(action)
            def note(self, fields):
                with (self.folder / "actions.jsonl").open("a") as file:
                    file.write(json.dumps(fields) + "\\n")
    """,
}


class FakeLerobot:
    """Environment with the package, at `python`; `device` is the folder of its device."""

    def __init__(self, folder: Path) -> None:
        packages = folder / "its packages"
        for name, source in _FILES.items():
            file = packages / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(dedent(source))
        self.python = folder / "an environment" / "python"
        self.python.parent.mkdir()
        self.python.write_text(
            f'#!/bin/sh\nPYTHONPATH="$PYTHONPATH:{packages}" TMPDIR="{folder}" exec {sys.executable} "$@"\n'
        )
        self.python.chmod(0o755)
        self.device = folder / "device"
        self.device.mkdir()
        self.play()

    def play(self, *faults: str) -> None:
        """Let the device have these faults, and no others."""
        new = self.device / "new.txt"
        new.write_text(" ".join(faults))
        new.replace(self.device / "faults.txt")

    def has_hung(self) -> bool:
        """Return True if a call of the device has not returned at some time."""
        return (self.device / "hung").exists()

    def notes(self) -> list[dict[str, float]]:
        """What the device was commanded, and when it was connected and disconnected."""
        file = self.device / "actions.jsonl"
        return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
