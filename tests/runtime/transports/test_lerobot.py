"""A LeRobot robot as a transport: its process, and what is passed on, refused and reported."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robots
from robots import Robot
from runtime.core.clock import MonotonicClock
from runtime.core.errors import ConfigurationError, SetupError
from runtime.core.types import ControlSource, Observation, RobotCommand
from runtime.transports import lerobot
from runtime.transports.lerobot import Config, LerobotSource
from runtime.transports.node_sink import NodeSink
from tests.processes import PATIENCE_S, alive, eventually
from tests.runtime.lerobot.fake_lerobot import FakeLerobot

_DESCRIPTION = """
title = "Two numbers"
urdf = "two.urdf"
limits_source = "the test"
control_rate = 50.0
cameras = { front = "cam_front" }
[lerobot.joints.arm]
pan = { feature = "pan.pos", unit = "degrees" }
[[groups]]
name = "arm"
joints = ["pan", "grip"]
urdf_joints = ["pan"]
gripper = { index = 1, unit = "m", lower = 0.0, upper = 0.1, open = 0.1, close = 0.0, velocity = 0.2 }
[poses.home]
arm = [0.0, 0.0]
"""
_URDF = """<robot name="two"><link name="base"/><link name="tip"/><joint name="pan" type="revolute">
<parent link="base"/><child link="tip"/><axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="1" effort="1"/>
</joint></robot>"""
GRIP = {"feature": "grip.pos", "theirs": [0.0, 100.0], "ours": [0.0, 0.1]}


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    folder = tmp_path / "robots" / "two"
    folder.mkdir(parents=True)
    (folder / "robot.toml").write_text(_DESCRIPTION)
    (folder / "two.urdf").write_text(_URDF)
    return robots.load_robot(folder)


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeLerobot:
    monkeypatch.setenv("EVA_SECRET_KEY", "of the web")
    return FakeLerobot(tmp_path)


def config(fake: FakeLerobot, **changes: Any) -> Config:
    device = {"type": "arm", "folder": str(fake.device), **changes.pop("device", {})}
    table = {"python": str(fake.python), "device": device, "cameras": {"cam_front": "front"}}
    return Config.model_validate(
        {**table, "joints": {"arm": {"grip": GRIP}}, "rate": 100.0, "stalled_after_s": 0.05, **changes}
    )


@contextlib.contextmanager
def connected(settings: Config, robot: Robot) -> Iterator[tuple[LerobotSource, NodeSink]]:
    clock = MonotonicClock()
    source, sink = lerobot.source(settings, robot, clock), lerobot.sink(settings, robot, clock)
    with contextlib.closing(source), contextlib.closing(sink):
        source.connect()
        sink.connect()
        yield source, sink


def observation(source: LerobotSource) -> Observation:
    found = eventually(lambda: source.receive(0.1), "an observation")
    assert found is not None
    return found


def said(source: LerobotSource, part: str) -> str:
    """The event about the waiting for the device that has `part`."""
    events: list[str] = []

    def found() -> str:
        events.extend(event.text for event in source.pop_events())
        return next((text for text in events if part in text), "")

    return eventually(found, f"{part!r} among {events}")


def command(sink: NodeSink, *numbers: float, source: ControlSource = "policy") -> None:
    sink.send(RobotCommand(np.array(numbers), 0, MonotonicClock().now(), source=source))


def commanded(fake: FakeLerobot) -> list[dict[str, float]]:
    return [note for note in fake.notes() if "pan.pos" in note]


def meet(fake: FakeLerobot, sink: NodeSink) -> None:
    """Command the joints that the device has, until it obeys: only then does it obey others."""

    def obeyed() -> bool:
        command(sink, math.pi / 2, 0.0)
        return bool(commanded(fake)) and commanded(fake)[-1] == pytest.approx(
            {"pan.pos": 90.0, "grip.pos": 0.0}
        )

    eventually(obeyed, "a command that is near")


def pid(fake: FakeLerobot) -> int:
    return int([note["connected"] for note in fake.notes() if "connected" in note][-1])


def test_its_numbers_are_ours_and_our_commands_are_its_numbers(fake: FakeLerobot, robot: Robot) -> None:
    with connected(config(fake), robot) as (source, sink):
        first = observation(source)
        np.testing.assert_allclose(first.qpos, [math.pi / 2, 0.1], rtol=1e-6)
        assert first.pictures["cam_front"].shape == (8, 8, 3)
        assert first.captured["joints"] <= first.arrived
        meet(fake, sink)
        before = len(fake.notes())

        def executed() -> bool:
            command(sink, math.pi / 4, 0.05)
            return commanded(fake)[-1] == pytest.approx({"pan.pos": 45.0, "grip.pos": 50.0})

        eventually(executed, "a command")
        eventually(lambda: observation(source) and source.status.master == sink.master, "the master")
        other = lerobot.sink(config(fake), robot, MonotonicClock())
        with contextlib.closing(other):
            other.connect()

            def refused() -> int:
                command(sink, math.pi / 4, 0.05)
                command(other, 0.0, 0.0)
                sink._send({"t": MonotonicClock().now(), "target": "real", "action": np.zeros(3, np.float32)})
                source.receive(0.1)
                return {"other_master", "dimension"} <= source.status.refused.keys()

            eventually(refused, "refusals of another master and of another dimension")
        eventually(lambda: observation(source) and source.status.holding, "a hold without commands")
        others = [note for note in fake.notes()[before:] if note["pan.pos"] != pytest.approx(90.0)]
        assert all(note == pytest.approx({"pan.pos": 45.0, "grip.pos": 50.0}) for note in others)
        process = pid(fake)
        assert b"of the web" not in Path(f"/proc/{process}/environ").read_bytes()
    assert not alive(process)
    assert fake.notes()[-1] == {"disconnected": process}


@pytest.mark.parametrize(
    ("fault", "name", "sentence"),
    [
        ("nan", "not_finite", "pan.pos is nan"),
        ("lacks", "missing_value", "grip.pos is missing"),
        ("size", "wrong_picture", "the picture front is uint8 [4, 4, 3]; expected uint8 [8, 8, 3]"),
        ("once", "device_failed", "ConnectionError: no status packet"),
        ("late", "device_failed", "ConnectionError: no status packet in time"),
    ],
)
def test_a_reading_that_is_not_usable_is_counted_and_not_passed_on(
    fake: FakeLerobot, robot: Robot, fault: str, name: str, sentence: str
) -> None:
    with connected(config(fake), robot) as (source, _):
        observation(source)
        process = pid(fake)
        fake.play(fault)
        eventually(lambda: source.faults().get(name, 0) > 1, name)
        assert sentence in source.describe_fault(name)
        while (newest := source.receive(0.0)) is not None:
            np.testing.assert_allclose(newest.qpos, [math.pi / 2, 0.1], rtol=1e-6)
        fake.play()
        observation(source)
        assert pid(fake) == process
        assert [note for note in fake.notes() if "disconnected" in note] == []


def test_a_device_that_gives_nothing_but_errors_is_connected_again(fake: FakeLerobot, robot: Robot) -> None:
    with connected(config(fake), robot) as (source, _):
        observation(source)
        fake.play("raises", "unplugged")
        assert "waiting for LeRobot's device arm" in said(source, "ConnectionError: no such port")
        assert {"disconnected": pid(fake)} in fake.notes()
        fake.play()
        observation(source)
        assert len([note for note in fake.notes() if "connected" in note]) == 2


def test_commands_that_waited_while_it_did_not_return_are_not_executed(
    fake: FakeLerobot, robot: Robot
) -> None:
    with connected(config(fake), robot) as (source, sink):
        observation(source)
        meet(fake, sink)
        fake.play("hangs")
        said(source, "does not return from reading")
        before = len(fake.notes())
        for number in range(20):
            command(sink, 0.01 * number, 0.0)
        said_again = MonotonicClock().now() + 2 * config(fake).deadline_s
        eventually(lambda: MonotonicClock().now() > said_again, "the deadline of the commands")
        fake.play()
        observation(source)
        observation(source)
        assert fake.notes()[before:] == []
        meet(fake, sink)


def test_after_a_connection_it_obeys_no_command_before_one_is_where_the_robot_is(
    fake: FakeLerobot, robot: Robot
) -> None:
    with connected(config(fake), robot) as (source, sink):

        def refused(*numbers: float) -> bool:
            command(sink, *numbers)
            return observation(source) and source.status.refused.get("displaced", 0) > 5  # type: ignore[return-value]

        def obeyed() -> bool:
            command(sink, 0.5, 0.0)
            return commanded(fake)[-1]["pan.pos"] < 30

        for _ in range(2):  # it has sagged meanwhile, and the station does not know it yet
            eventually(lambda: refused(math.pi / 2 - 0.2, 0.0), "refusals")
            assert commanded(fake) == []
            assert source.status.holding
            meet(fake, sink)
            eventually(obeyed, "a command")
            os.kill(pid(fake), signal.SIGKILL)
            (fake.device / "actions.jsonl").unlink()
            eventually(lambda: fake.notes(), "another process")
            eventually(lambda: observation(source) and not source.status.refused, "its first words")


def test_under_the_e_stop_it_is_not_connected_again(fake: FakeLerobot, robot: Robot) -> None:
    with connected(config(fake), robot) as (source, sink):
        observation(source)
        first = pid(fake)
        os.kill(first, signal.SIGKILL)

        def waits() -> bool:
            command(sink, 0.5, 0.0, source="estop")
            return any("when the e-stop is released" in event.text for event in [*source.pop_events()])

        def receive() -> bool:
            source.receive(0.01)
            return waits()

        eventually(receive, "that it waits")
        assert pid(fake) == first

        def again() -> bool:
            command(sink, 0.5, 0.0, source="hold")
            return pid(fake) != first

        eventually(again, "another connection")


def test_a_device_that_refuses_commands_stays_connected_and_acknowledges_none(
    fake: FakeLerobot, robot: Robot
) -> None:
    fake.play("refuses")
    with connected(config(fake), robot) as (source, sink):
        observation(source)

        def refused() -> bool:
            command(sink, math.pi / 2, 0.0)
            observation(source)
            return source.status.refused.get("device", 0) > 50

        eventually(refused, "refusals")
        assert source.faults()["command_failed"] > 50
        assert source.describe_fault("command_failed") == "ValueError: goal out of range"
        assert source.status.holding
        assert source.status.ack is None
        assert len([note for note in fake.notes() if "connected" in note or "disconnected" in note]) == 1


def test_what_a_driver_has_started_does_not_hide_the_end_of_the_process(
    fake: FakeLerobot, robot: Robot
) -> None:
    fake.play("forks")
    with connected(config(fake), robot) as (source, _):
        observation(source)
        first = pid(fake)
        os.kill(first, signal.SIGKILL)
        eventually(lambda: observation(source) and pid(fake) != first, "another process")
    forked = [int(note["forked"]) for note in fake.notes() if "forked" in note]
    assert len(forked) == 2
    eventually(lambda: not any(map(alive, forked)), "the end of what the driver has started")


def test_a_process_that_ends_is_started_again_and_one_that_hangs_ends_with_the_source(
    fake: FakeLerobot, robot: Robot
) -> None:
    with connected(config(fake), robot) as (source, sink):
        observation(source)
        first = pid(fake)
        os.kill(first, signal.SIGKILL)
        eventually(lambda: observation(source) and pid(fake) != first, "another process")
        command(sink, 0.5, 0.0)
        fake.play("dies")
        said(source, "its process has ended (3)")
        fake.play("uncalibrated")
        text = said(source, "not calibrated")
        assert text.endswith("-m lerobot.scripts.lerobot_calibrate --robot.type=arm")
        fake.play("asks")
        said(source, "EOFError")
        fake.play()
        observation(source)
        fake.play("hangs")
        said(source, "does not return from reading")
        last = pid(fake)
    assert not alive(last)


def test_the_process_ends_with_its_station_however_that_ends(fake: FakeLerobot, robot: Robot) -> None:
    code = (
        "import sys, robots\n"
        "from runtime.core.clock import MonotonicClock\nfrom runtime.transports import lerobot\n"
        "config = lerobot.Config.model_validate_json(sys.argv[1])\n"
        "source = lerobot.source(config, robots.load_robot(sys.argv[2]), MonotonicClock())\n"
        "source.connect()\nprint(source.receive(60.0) is not None, flush=True)\nsource.receive(60.0)\ninput()"
    )
    words = [sys.executable, "-c", code, config(fake).model_dump_json(), str(robot.folder)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as station:
        assert station.stdout is not None
        assert station.stdout.readline() == "True\n"
        process = pid(fake)
        station.kill()
    eventually(lambda: not alive(process), "the end of the device's process")
    assert fake.notes()[-1] == {"disconnected": process}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"device": {"type": "leg"}},
            "device.type = 'leg'; allowed: arm, third; cannot be imported here: broken",
        ),
        ({"device": {"prt": 1}}, "device.prt: unknown key of arm; allowed: id, folder, port"),
        ({"cameras": {"cam_front": "back"}}, "cameras: pictures back do not exist; the device has front"),
        (
            {"joints": {"arm": {"grip": GRIP | {"feature": "g.pos"}}}},
            "observation features g.pos do not exist; the device has pan.pos, grip.pos",
        ),
        (
            {"joints": {"arm": {"grip": GRIP | {"feature": "pan.pos"}}}},
            "joints: more than one has the feature pan.pos; allowed: one each",
        ),
    ],
)
def test_what_the_device_does_not_have_is_named_with_what_it_has(
    fake: FakeLerobot, robot: Robot, changes: dict[str, Any], sentence: str
) -> None:
    with connected(config(fake, **changes), robot) as (source, _):
        said(source, sentence)
        assert fake.notes() == []


def test_one_port_has_one_process(fake: FakeLerobot, robot: Robot) -> None:
    port = {"device": {"port": str(fake.device / "tty")}}
    with connected(config(fake, **port), robot) as (source, _):
        observation(source)
        with connected(config(fake, **port, rate=20.0), robot) as (second, _):
            said(second, "another process has the device")
            assert second.receive(0.0) is None
        observation(source)


def test_what_a_deployment_says_of_joints_cameras_and_python_is_checked(
    fake: FakeLerobot, robot: Robot, tmp_path: Path
) -> None:
    assert lerobot.cameras(config(fake, disabled_cameras=["cam_front"]), robot) == ()
    assert lerobot.capabilities(config(fake)).moves_robot
    with pytest.raises(ConfigurationError, match=r"transport.joints.arm lacks grip: neither"):
        lerobot.cameras(config(fake, joints={}), robot)
    with pytest.raises(
        ConfigurationError, match=r"transport.joints.arm: lift not of two; allowed: pan, grip"
    ):
        lerobot.cameras(config(fake, joints={"arm": {"lift": GRIP}}), robot)
    with pytest.raises(ConfigurationError, match=r"transport.cameras: wrist not of two; allowed: cam_front"):
        lerobot.cameras(config(fake, cameras={"wrist": "front"}), robot)
    with pytest.raises(SetupError, match=r"transport.python = '/no/python' cannot be run"):
        lerobot.capabilities(config(fake, python="/no/python"))
    bare = tmp_path / "bare"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -I -S "$@"\n')
    bare.chmod(0o755)
    with pytest.raises(SetupError, match="lacks lerobot, numpy, zmq, msgpack; install there"):
        lerobot.capabilities(config(fake, python=str(bare)))


@pytest.mark.parametrize(
    "ranges", [{"theirs": [0, 1]}, {"theirs": [1, 1], "ours": [0, 1]}, {"unit": "turns"}]
)
def test_a_conversion_needs_a_unit_or_two_ranges(fake: FakeLerobot, ranges: dict[str, Any]) -> None:
    joint = {"feature": "grip.pos", **ranges}
    with pytest.raises(ValueError, match=r"allowed: `unit`, or both|Input should be 'same' or 'degrees'"):
        config(fake, joints={"arm": {"grip": joint}})


def test_by_hand_it_is_a_node_of_any_station(fake: FakeLerobot, robot: Robot, tmp_path: Path) -> None:
    file = tmp_path / "node.toml"
    ends = {name: f"ipc://{tmp_path}/{name}" for name in ("observations", "commands")}
    file.write_text(
        f'role = "robot"\nobservations = "{ends["observations"]}"\ncommands = "{ends["commands"]}"\n'
        f'device = {{ type = "arm", folder = "{fake.device}" }}\ncameras = {{ cam_front = "front" }}\n'
        '[joints.arm]\npan = { feature = "pan.pos", unit = "degrees" }\n'
        'grip = { feature = "grip.pos", theirs = [0, 100], ours = [0, 0.1] }\n'
    )
    from runtime.transports import zmq

    settings = zmq.Config(sub_endpoint=ends["observations"], pub_endpoint=ends["commands"])
    line = [str(fake.python), "-m", "runtime.lerobot.host", str(file)]
    root = Path(robots.__file__).parents[1]
    with subprocess.Popen(line, cwd=root) as host:
        with contextlib.closing(zmq.source(settings, robot, MonotonicClock())) as source:
            source.connect()
            found = eventually(lambda: source.receive(0.1), "an observation")
            assert found is not None
            np.testing.assert_allclose(found.qpos, [math.pi / 2, 0.1], rtol=1e-6)
        host.send_signal(signal.SIGTERM)
        assert host.wait(PATIENCE_S) == 0
    assert fake.notes()[-1] == {"disconnected": host.pid}
    with subprocess.Popen(line, cwd=root) as host:
        eventually(lambda: {"connected": host.pid} in fake.notes(), "that it is connected")
        fake.play("hangs")
        eventually(lambda: fake.has_hung(), "a call that does not return")
        host.send_signal(signal.SIGTERM)
        assert host.wait(PATIENCE_S) == 1
