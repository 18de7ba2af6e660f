"""Both ends of each transport that `benchmarks.wires_transports` measures: one function per transport."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import robots
from benchmarks.labs import ROOT
from benchmarks.wires_receiver import FPS
from benchmarks.wires_recording import record
from runtime.core.errors import ConfigurationError, SetupError
from runtime.core.plugins import variants
from runtime.simulation.ros.ros_domain import free_domain

ROBOT, ROS2_ROBOT = "agilex_piper", "r1_lite"
PATIENCE_S = 60.0
_SECONDS_OF_VIDEO = 10
_MOST_DECODED_HZ = 200.0


@dataclass(slots=True)
class CaseSetup:
    """Context in which a case is opened: its processes, its folder, and its sender."""

    stack: contextlib.ExitStack
    folder: Path
    rate: float
    size: tuple[int, int]
    robot: str
    page: int  # file descriptor of the shared state
    hurried: bool  # as fast as possible without loss
    times: Path = field(init=False)
    sender: subprocess.Popen[str] | None = None

    def __post_init__(self) -> None:
        self.times = self.folder / "times.json"

    def send(self, module: str, *arguments: str) -> Mapping[str, Any]:
        """Start the sender, and return the addresses that it announces."""
        page = str(self.page) if self.hurried else ""
        command = [sys.executable, "-m", "benchmarks.wires_sender", str(self.times), page, module, *arguments]
        self.sender = self.stack.enter_context(process(command, self.page))
        assert self.sender.stdout is not None
        line = self.sender.stdout.readline()
        if not line:
            raise SystemExit(f"the sender {module} ended with {self.sender.wait()}")
        announced: Mapping[str, Any] = json.loads(line)
        return announced

    def sized(self) -> tuple[str, ...]:
        """Return rate and image size as options of a simulated robot."""
        return ("--rate", str(self.rate), "--height", str(self.size[0]), "--width", str(self.size[1]))

    def sent(self) -> Any:
        """End the sender; return the start times of its messages."""
        if self.sender is None:
            return []
        end(self.sender)
        return json.loads(self.times.read_text("utf-8"))


@dataclass(frozen=True, slots=True)
class CaseEndpoints:
    """Transport and cameras of the receiving side.

    `born` says how the time at which an image began is determined: "strip" and "bar" are marks in the image that encode
    the image's number, and "due" is the time at which an image of a recording was due.
    """

    transport: Mapping[str, Any]
    cameras: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    born: str = "strip"


@dataclass(frozen=True, slots=True)
class Case:
    """Transport to measure; its name is used in the figures.

    `needs` is the kind of transport that must be available. `program` is a program that must be installed, "" for none.
    `idle` is False if memory growth is not measured, because another case covers it.
    """

    name: str
    needs: str
    open: Callable[[CaseSetup], CaseEndpoints]
    robot: str = ROBOT
    played: bool = False  # of a recording, as fast as it is read
    program: str = ""
    idle: bool = True


def cases() -> list[Case]:
    """Return all cases."""
    return [
        Case("zmq", "zmq", _zmq),
        Case("ros1", "ros1", _ros1, program="rosmaster"),
        Case("ros2", "ros2", _ros2_raw, ROS2_ROBOT),
        Case("ros2_jpeg", "ros2", _ros2, ROS2_ROBOT, idle=False),
        Case("dataset", "dataset", _dataset, played=True),
        Case("file_cameras", "dataset", _file_cameras, played=True),
        Case("mjpeg_cameras", "zmq", _mjpeg_cameras),
    ]


def absent(case: Case) -> str:
    """Return why a case cannot be measured on this machine, "" if it can."""
    module = variants("runtime.transports").get(case.needs)
    if module is None:
        return f"there is no transport {case.needs!r}"
    required = {"path": "."} if case.needs == "dataset" else {}
    try:
        module.capabilities(module.Config(**required))
    except (SetupError, ConfigurationError) as error:
        return str(error)
    if case.program and shutil.which(case.program) is None:
        return f"there is no program {case.program!r}"
    return ""


@contextlib.contextmanager
def process(command: Sequence[str], *descriptors: int) -> Iterator[subprocess.Popen[str]]:
    """Start a process and yield it; at the end of the context, close its standard input, on which it ends.

    The process inherits the file descriptors `descriptors`.
    """
    child = subprocess.Popen(
        command,
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        pass_fds=descriptors,
        text=True,
    )
    assert child.stdout is not None
    try:
        yield child
    finally:
        end(child)
        child.stdout.close()


def end(child: subprocess.Popen[str]) -> None:
    assert child.stdin is not None
    child.stdin.close()
    try:
        child.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def _node(stage: CaseSetup, *more: str) -> dict[str, Any]:
    """Start a simulated node, and return its transport."""
    free = ("--obs-endpoint", "tcp://127.0.0.1:0", "--action-endpoint", "tcp://127.0.0.1:0")
    announced = stage.send("node", "--robot", stage.robot, *free, *more)
    return {
        "kind": "zmq",
        "sub_endpoint": announced["obs_endpoint"],
        "pub_endpoint": announced["action_endpoint"],
    }


def _zmq(stage: CaseSetup) -> CaseEndpoints:
    return CaseEndpoints(_node(stage, *stage.sized()))


def _ros2(stage: CaseSetup) -> CaseEndpoints:
    """Set up the benchmark case of ROS 2 with images as JPEG, as the robot publishes them."""
    domain = stage.stack.enter_context(free_domain())
    stage.send("ros2_node", "--robot", stage.robot, "--domain", str(domain), *stage.sized())
    return CaseEndpoints({"kind": "ros2", "domain": domain})


def _ros2_raw(stage: CaseSetup) -> CaseEndpoints:
    """Set up the benchmark case of ROS 2 with images as raw pixels, from the same robot."""
    folder = stage.folder / stage.robot
    shutil.copytree(ROOT / "robots" / stage.robot, folder)
    described = (folder / "robot.toml").read_text("utf-8")
    (folder / "robot.toml").write_text(described.replace('/compressed"', '"'), "utf-8")
    stage.robot = str(folder)
    return _ros2(stage)


def _ros1(stage: CaseSetup) -> CaseEndpoints:
    """Open the case in which ROS 1 is used with rospy at both ends and with a separate master."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    master = f"http://127.0.0.1:{port}"
    around = {"ROS_MASTER_URI": master, "ROS_IP": "127.0.0.1", "ROS_HOME": str(stage.folder)}
    stage.stack.enter_context(_master(port, os.environ | around))
    stage.send("ros1_node", "--robot", stage.robot, "--master", master, *stage.sized())
    return CaseEndpoints({"kind": "ros1", "master": master})


@contextlib.contextmanager
def _master(port: int, environment: Mapping[str, str]) -> Iterator[None]:
    """Run a ROS 1 master within the context."""
    child = subprocess.Popen(
        ["rosmaster", "--core", "-p", str(port)], env=environment, stdout=subprocess.DEVNULL
    )
    try:
        latest = time.monotonic() + PATIENCE_S
        with socket.socket() as knocking:
            while knocking.connect_ex(("127.0.0.1", port)):
                if child.poll() is not None or time.monotonic() > latest:
                    raise SystemExit(f"rosmaster does not answer at {port}")
                time.sleep(0.05)
        yield
    finally:
        child.terminate()
        child.wait(PATIENCE_S)


def _dataset(stage: CaseSetup) -> CaseEndpoints:
    return CaseEndpoints(_recorded(stage)[0], born="due")


def _file_cameras(stage: CaseSetup) -> CaseEndpoints:
    """Set up the case in which a recording is played, and file cameras play its videos.

    The recording's own pictures are replaced by those of the file cameras.
    """
    transport, videos = _recorded(stage)
    cameras = {key: {"kind": "file", "path": str(path)} for key, path in videos.items()}
    return CaseEndpoints(transport, cameras, born="due")


def _recorded(stage: CaseSetup) -> tuple[dict[str, Any], dict[str, Path]]:
    path = stage.folder / "dataset"
    videos = record(path, robots.load_robot(stage.robot), int(_SECONDS_OF_VIDEO * FPS), int(FPS), *stage.size)
    return {"kind": "dataset", "path": str(path)}, videos


def _mjpeg_cameras(stage: CaseSetup) -> CaseEndpoints:
    """Open the case in which network cameras send the images, next to a node whose own images are minimal.

    The rate is limited, because images that arrive faster than they are decoded are skipped.
    """
    keys = [camera.key for camera in robots.load_robot(stage.robot).cameras]
    rate, stage.hurried = str(min(stage.rate, _MOST_DECODED_HZ)), False
    transport = _node(stage, "--rate", rate, "--height", "32", "--width", "32")
    height, width = stage.size
    announced = stage.send("cameras", str(len(keys)), rate, str(width), str(height))
    cameras = {key: {"kind": "mjpeg", "url": url} for key, url in zip(keys, announced["urls"], strict=True)}
    return CaseEndpoints(transport, cameras, born="bar")
