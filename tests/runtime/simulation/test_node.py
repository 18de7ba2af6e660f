from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

import robots
from runtime.core import msgpack_arrays
from runtime.core.clock import MonotonicClock, VirtualClock
from runtime.core.errors import CodecError, SetupError
from runtime.core.types import Float64, Observation, RobotCommand
from runtime.simulation import node as module
from runtime.simulation.bench.bench import overhead_camera
from runtime.simulation.bench.layout import draw_layout
from runtime.simulation.bench.numbered_frames import frame_number
from runtime.simulation.node import Node, parser
from runtime.transports import zmq as link
from runtime.transports.node_messages import NodeMessages
from runtime.transports.node_sink import NodeSink
from runtime.transports.node_source import NodeSource
from runtime.transports.zmq import Config
from tests.processes import PATIENCE_S

ROBOT = robots.load_robot("agilex_piper")
HOME = ROBOT.poses["home"]
KEYS = [camera.key for camera in ROBOT.cameras]
FREE = ["--obs-endpoint", "tcp://127.0.0.1:0", "--action-endpoint", "tcp://127.0.0.1:0"]
SMALL = [*FREE, "--width", "96", "--height", "60"]
PERIOD = 1 / 30

AWAY = np.clip(HOME + 0.2, ROBOT.lower, ROBOT.upper)


class Bench:
    """A node on a clock that a test moves, and plain sockets on the other side."""

    def __init__(self, *arguments: str) -> None:
        self.clock = VirtualClock(1000.0)
        self.number = 0
        options = parser().parse_args(["--robot", "agilex_piper", *SMALL, *arguments])
        self.node = Node(ROBOT, options, self.clock)
        ready = self.node.open()
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
        self.frames, self.commands = context.socket(zmq.SUB), context.socket(zmq.PUB)
        self.frames.setsockopt(zmq.SUBSCRIBE, b"")
        self.frames.connect(ready["obs_endpoint"])
        self.commands.connect(ready["action_endpoint"])
        self._join()
        self.inbox: list[bytes] = []
        assert self.node._sockets is not None
        self.drain = self.node._sockets.received
        self.node._sockets.received = self._arrived  # type: ignore[method-assign]

    def tick(self, count: int = 1) -> dict[str, Any]:
        """Ticks of one period each; the last observation."""
        payload = b""
        for _ in range(count):
            self.clock.advance(PERIOD)
            self.node.tick(PERIOD)
            assert self.frames.poll(int(PATIENCE_S * 1e3))
            payload = self.frames.recv()
        return dict(msgpack_arrays.unpack(payload))

    def send(self, action: Any = HOME, **fields: Any) -> None:
        """A command that has arrived at the node when this returns."""
        message = {"t": 0.0, "action": np.asarray(action, np.float32), "target": "real"} | fields
        self.number += 1
        self.post(msgpack_arrays.pack(message | {"seq": self.number}))

    def post(self, payload: bytes) -> None:
        self.commands.send(payload)
        deadline = time.monotonic() + PATIENCE_S
        while payload not in self.inbox:
            assert time.monotonic() < deadline
            self.inbox += self.drain()

    def _arrived(self) -> list[bytes]:
        inbox, self.inbox = self.inbox, []
        return inbox

    def _join(self) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not self.frames.poll(20):
            assert time.monotonic() < deadline
            self.node.tick(0.0)
        while self.frames.poll(100):
            self.frames.recv()
        assert self.node._sockets is not None
        commands = self.node._sockets._subscriber
        while not commands.poll(20):
            assert time.monotonic() < deadline
            self.commands.send(msgpack_arrays.pack({"t": 0.0, "target": "sim", "master": "joiner"}))
        while commands.poll(100):
            commands.recv()

    def close(self) -> None:
        self.node.close()
        self.frames.close(linger=0)
        self.commands.close(linger=0)


@pytest.fixture
def bench() -> Iterator[Bench]:
    with contextlib.closing(Bench()) as made:
        yield made


def joints(observation: dict[str, Any]) -> Float64:
    return np.asarray(ROBOT.join(observation["state"]), np.float64)


# One tick at a time


def test_an_observation_has_the_fields_of_the_protocol(bench: Bench) -> None:
    said = bench.tick()
    assert list(said)[:4] == ["t", "images", "state", "eef"]
    assert said["t"] == pytest.approx(bench.clock.now())
    assert list(said["images"]) == KEYS
    assert {name: part.dtype.str for name, part in said["state"].items()} == {
        "left_arm": "<f4",
        "right_arm": "<f4",
    }
    assert said["hil_supported"] is False
    assert said["hil_active"] is False
    assert said["encoding"] == "bgr"
    assert said["proto"] == 1
    assert "action" not in said
    assert "hil_error" not in said
    np.testing.assert_allclose(joints(said), HOME, atol=1e-6)


def test_poses_are_those_of_the_joints(bench: Bench) -> None:
    bench.send(AWAY)
    said = bench.tick(3)
    arm = ROBOT.group("left_arm")
    assert arm.chain is not None
    expected = arm.chain.pose(joints(said)[arm.joint_dims])
    np.testing.assert_allclose(said["eef"]["left_arm"][:7], expected, atol=1e-5)


@pytest.mark.some(1)
@pytest.mark.parametrize("name", [name for name in robots.robot_names() if name != "agilex_piper"])
def test_any_robot_goes_where_it_is_told_and_measures_what_its_chains_say(name: str) -> None:
    robot = robots.load_robot(name)
    clock = VirtualClock()
    line = [
        "--robot",
        name,
        "--bench",
        "tabletop",
        "--width",
        "96",
        "--height",
        "72",
        "--start-pose",
        "ready",
    ]
    node = Node(robot, parser().parse_args(line), clock)
    start = robot.poses["ready"]
    target = np.clip(start + 0.05 * np.minimum(1.0, robot.upper - robot.lower), robot.lower, robot.upper)
    for _ in range(45):
        clock.advance(PERIOD)
        said = msgpack_arrays.unpack(
            node.exchange([msgpack_arrays.pack({"t": 0.0, "action": target.astype(np.float32)})], PERIOD)
        )
    found = np.asarray(robot.join(said["state"]), np.float64)
    np.testing.assert_allclose(found, target, atol=1e-3)
    assert said["refused"] == {}
    assert {key: picture.shape for key, picture in said["images"].items()} == {
        camera.key: (72, 96, 3) for camera in robot.cameras
    }
    for arm in robot.arms:
        np.testing.assert_allclose(said["eef"][arm.name][:7], arm.pose(found), atol=1e-5)
        assert said["eef"][arm.name][7] == np.float32(found[arm.gripper_dim])


def test_a_robot_that_measures_no_poses_sends_none() -> None:
    node = Node(ROBOT, parser().parse_args(["--robot", "agilex_piper", *SMALL, "--no-eef"]), VirtualClock())
    assert "eef" not in msgpack_arrays.unpack(node.exchange([], PERIOD))


def test_frame_numbers_in_the_message_and_in_the_pictures_agree(bench: Bench) -> None:
    for _ in range(3):
        said = bench.tick()
        assert {frame_number(picture) for picture in said["images"].values()} == {said["seq"]}


def test_it_follows_the_newest_command(bench: Bench) -> None:
    for target in (HOME, AWAY):
        bench.send(target)
    said = bench.tick()
    assert said["holding"] is False
    for _ in range(40):
        bench.send(AWAY)
        said = bench.tick()
    np.testing.assert_allclose(joints(said), AWAY, atol=1e-4)


def test_it_holds_where_it_is_after_the_deadline_and_says_so(bench: Bench) -> None:
    assert bench.tick()["holding"] is True
    bench.send(AWAY)
    assert bench.tick()["holding"] is False
    bench.clock.advance(0.3)
    held = bench.tick()
    assert held["holding"] is True
    later = bench.tick(30)
    np.testing.assert_array_equal(joints(later), joints(held))
    assert np.abs(joints(held) - AWAY).max() > 0.01
    bench.send(AWAY)
    assert bench.tick()["holding"] is False


@pytest.mark.parametrize(
    ("action", "reason"),
    [(HOME[:13], "dimension"), (np.full(14, np.nan), "not_finite"), (np.full(14, 9.0), "limits")],
)
def test_a_command_it_refuses_moves_nothing_and_is_reported(bench: Bench, action: Any, reason: str) -> None:
    bench.send(action)
    said = bench.tick(5)
    assert said["refused"] == {reason: 1}
    assert said["holding"] is True
    np.testing.assert_allclose(joints(said), HOME, atol=1e-6)


def test_a_malformed_command_does_not_end_it(bench: Bench) -> None:
    for payload in (b"", b"\xc1", b"\x85\xa1t", msgpack_arrays.pack("hello")):
        bench.post(payload)
    assert bench.tick()["refused"] == {"malformed": 4}
    bench.send(AWAY)
    assert bench.tick()["holding"] is False


def test_a_second_client_is_refused_while_the_first_commands(bench: Bench) -> None:
    bench.send(HOME, master="first")
    bench.send(AWAY, master="second")
    said = bench.tick(5)
    assert said["master"] == "first"
    assert said["refused"] == {"other_master": 1}
    np.testing.assert_allclose(joints(said), HOME, atol=1e-6)
    bench.clock.advance(1.0)
    bench.send(AWAY, master="second")
    said = bench.tick(5)
    assert said["master"] == "second"
    assert np.abs(joints(said) - HOME).max() > 0.05


def test_collecting_moves_by_itself_and_reports_what_it_applied(bench: Bench) -> None:
    for _ in range(5):
        bench.send(np.zeros(14), target="collect_start")
    said = [bench.tick() for _ in range(60)]
    applied = np.array([each["action"] for each in said])
    assert np.ptp(applied, axis=0).max() > 0.2
    assert np.abs(np.diff(applied, axis=0)).max() * 30 < 1.0
    assert said[-1]["action_eef"].shape == (16,)
    assert said[-1]["holding"] is False
    bench.send(AWAY)
    assert bench.tick()["refused"] == {"collecting": 1}
    for _ in range(5):
        bench.send(np.zeros(14), target="collect_stop")
    stopped = bench.tick()
    assert "action" not in stopped
    np.testing.assert_array_equal(joints(bench.tick(30)), joints(stopped))


def test_a_repeated_start_does_not_begin_the_collection_anew(bench: Bench) -> None:
    with contextlib.closing(Bench()) as other:
        for made, copies in ((bench, 1), (other, 5)):
            for _ in range(copies):
                made.send(np.zeros(14), target="collect_start")
                made.tick(1 if copies > 1 else 5)
        np.testing.assert_array_equal(bench.tick()["action"], other.tick()["action"])


def test_a_human_in_the_loop_is_refused_with_a_reason_until_stopped(bench: Bench) -> None:
    for _ in range(5):
        bench.send(np.zeros(14), target="hil_start", mode="relative")
    said = bench.tick()
    assert said["hil_active"] is False
    assert said["hil_error"] == "the simulated node has no leader arm"
    bench.send(np.zeros(14), target="hil_stop")
    assert "hil_error" not in bench.tick()


def test_drives_are_reported_and_off_nothing_moves(bench: Bench) -> None:
    assert bench.tick()["drives"] == {"enabled": True, "faults": []}
    bench.send(AWAY)
    started = joints(bench.tick())
    assert np.abs(started - HOME).max() > 0
    bench.send(target="drives_fault", fault="axis 2 is hot")
    stopped = joints(bench.tick())
    bench.send(AWAY)
    said = bench.tick(10)
    assert said["drives"] == {"enabled": False, "faults": ["axis 2 is hot"]}
    np.testing.assert_array_equal(joints(said), stopped)
    bench.send(target="drives_enable")
    bench.send(AWAY)
    said = bench.tick(3)
    assert said["drives"] == {"enabled": True, "faults": []}
    assert np.abs(joints(said) - stopped).max() > 0


@pytest.mark.parametrize(
    ("options", "drives"),
    [
        (["--drives-disabled"], {"enabled": False, "faults": []}),
        (["--drive-fault", "hot", "--drive-fault", "lost"], {"enabled": False, "faults": ["hot", "lost"]}),
    ],
)
def test_it_can_begin_with_drives_that_are_off(options: list[str], drives: dict[str, Any]) -> None:
    with contextlib.closing(Bench(*options)) as made:
        made.send(AWAY)
        said = made.tick(3)
        assert said["drives"] == drives
        np.testing.assert_allclose(joints(said), HOME, atol=1e-6)


def test_collecting_waits_while_the_drives_are_off(bench: Bench) -> None:
    bench.send(target="collect_start")
    bench.tick(3)
    bench.send(target="drives_disable")
    stopped = joints(bench.tick())
    np.testing.assert_array_equal(joints(bench.tick(5)), stopped)


def test_a_frozen_camera_repeats_its_first_picture() -> None:
    with contextlib.closing(Bench("--freeze-camera", "cam_high")) as bench:
        first, later = bench.tick(), bench.tick(5)
    np.testing.assert_array_equal(first["images"]["cam_high"], later["images"]["cam_high"])
    assert frame_number(later["images"]["cam_left_wrist"]) == later["seq"]
    assert later["t"] > first["t"]


def test_a_dropped_camera_is_missing() -> None:
    with contextlib.closing(Bench("--drop-camera", "cam_left_wrist")) as bench:
        assert list(bench.tick()["images"]) == ["cam_high", "cam_right_wrist"]


def test_every_nth_message_is_cut() -> None:
    with contextlib.closing(Bench("--malformed-every", "3")) as bench:
        broken = []
        for _ in range(9):
            bench.clock.advance(PERIOD)
            bench.node.tick(PERIOD)
            assert bench.frames.poll(int(PATIENCE_S * 1e3))
            try:
                msgpack_arrays.unpack(bench.frames.recv())
            except CodecError:
                broken.append(True)
            else:
                broken.append(False)
    assert sum(broken) == 3


def test_its_clock_can_be_set_off() -> None:
    with contextlib.closing(Bench("--clock-offset", "-400")) as bench:
        assert bench.tick()["t"] == pytest.approx(bench.clock.now() - 400)


POSITIONS = {"block": [0.15, 0.2, 30.0], "plate": [0.15, 0.37]}


@pytest.fixture
def tabletop() -> Iterator[Bench]:
    with contextlib.closing(Bench("--bench", "tabletop", "--start-pose", "ready", "--seed", "5")) as made:
        yield made


def test_without_a_bench_there_is_no_truth_and_nothing_to_lay(bench: Bench) -> None:
    bench.send(target="scene_reset", id="one", seed=3)
    said = bench.tick()
    assert "truth" not in said
    assert said["refused"] == {"no_bench": 1}


def test_a_tabletop_says_how_it_really_is(tabletop: Bench) -> None:
    said = tabletop.tick()
    np.testing.assert_allclose(joints(said), ROBOT.poses["ready"], atol=1e-6)
    layout = draw_layout(5)
    truth = said["truth"]
    assert truth["reset"] == ""
    assert truth["seed"] == 5
    assert truth["blocks"] == [pytest.approx([*layout.blocks[0][:2], 0.02, layout.blocks[0][2]])]
    assert truth["plate"] == pytest.approx(layout.discs[0])
    assert truth["held"] == [""]
    assert truth["milestones"] == {"grasped": False, "lifted": False, "over_plate": False, "placed": False}
    assert truth["success"] is False


def test_a_scene_reset_lays_the_bench_once_and_the_pictures_show_it(tabletop: Bench) -> None:
    before = tabletop.tick()
    for _ in range(3):
        tabletop.send(target="scene_reset", id="one", seed=3, positions=POSITIONS)
    said = tabletop.tick()
    layout = draw_layout(3, POSITIONS)
    assert said["truth"]["reset"] == "one"
    assert said["truth"]["seed"] == 3
    assert said["truth"]["blocks"][0][:2] == pytest.approx(layout.blocks[0][:2])
    assert said["refused"] == {}
    camera = overhead_camera(96, 60)
    u, v = camera.project(np.array([*layout.blocks[0][:2], 0.04])).round().astype(int)
    blue, _, red = said["images"]["cam_high"][v, u].astype(int)
    assert red > blue + 80
    assert not np.array_equal(before["images"]["cam_high"], said["images"]["cam_high"])
    np.testing.assert_array_equal(said["images"]["cam_high"], tabletop.tick()["images"]["cam_high"])
    tabletop.send(target="scene_reset", id="two", seed=3)
    assert tabletop.tick()["truth"]["reset"] == "two"


def test_a_layout_that_cannot_be_is_refused_and_changes_nothing(tabletop: Bench) -> None:
    before = tabletop.tick()["truth"]
    tabletop.send(target="scene_reset", id="one", seed=3, positions={"plate": [3.0, 0.3]})
    said = tabletop.tick()
    assert said["refused"] == {"bench_layout": 1}
    refused = said["truth"].pop("refused")
    assert (refused["id"], said["truth"]) == ("one", before)
    assert refused["why"].startswith("positions: plate at x 3000, y 300 mm; allowed on a simulated bench")


def test_the_arms_over_a_bench_obey_as_without_one(tabletop: Bench) -> None:
    target = ROBOT.poses["ready"].copy()
    target[0] += 0.2
    for _ in range(40):
        tabletop.send(target)
        said = tabletop.tick()
    np.testing.assert_allclose(joints(said), target, atol=1e-4)
    tabletop.clock.advance(0.3)
    assert tabletop.tick()["holding"] is True


def test_a_bench_can_have_more_blocks() -> None:
    with contextlib.closing(Bench("--bench", "tabletop", "--blocks", "3")) as bench:
        assert len(bench.tick()["truth"]["blocks"]) == 3


def test_the_node_with_a_bench_is_one_that_the_link_understands(tabletop: Bench) -> None:
    tabletop.clock.advance(PERIOD)
    tabletop.node.tick(PERIOD)
    assert tabletop.frames.poll(int(PATIENCE_S * 1e3))
    frame = NodeMessages(ROBOT, "bgr", frozenset(), 2**24).read(tabletop.frames.recv())
    assert frame.truth is not None
    assert frame.truth["success"] is False


@pytest.mark.parametrize("name", robots.robot_names())
def test_every_robot_can_be_simulated(name: str) -> None:
    robot = robots.load_robot(name)
    options = parser().parse_args(["--robot", name, *SMALL])
    with contextlib.closing(Node(robot, options, VirtualClock())) as node:
        node.open()
        node.tick(PERIOD)
        message = msgpack_arrays.unpack(msgpack_arrays.pack(node._observation()))
    assert list(message["state"]) == [group.name for group in robot.groups]
    assert list(message["images"]) == [camera.key for camera in robot.cameras]


@pytest.mark.parametrize("option", ["--freeze-camera", "--drop-camera"])
def test_a_camera_that_the_robot_does_not_have_is_refused(option: str) -> None:
    options = parser().parse_args(["--robot", "agilex_piper", option, "cam_low"])
    with pytest.raises(SetupError, match="no camera 'cam_low'; it has cam_high"):
        Node(ROBOT, options, VirtualClock())


def test_it_does_not_listen_beyond_this_machine_unasked() -> None:
    options = parser().parse_args(["--robot", "agilex_piper", "--obs-endpoint", "tcp://0.0.0.0:0"])
    with pytest.raises(SetupError, match="--insecure-link"):
        Node(ROBOT, options, VirtualClock()).open()


def test_missed_ticks_are_skipped_and_the_others_keep_their_times_or_are_a_little_late() -> None:
    clock = VirtualClock(0.0)
    told = _Told()
    starts: list[float] = []

    class Slow:
        def tick(self, seconds: float) -> None:
            starts.append(clock.now())
            clock.advance({2: 0.37, 4: 0.13}.get(len(starts), 0.01))
            told.done = len(starts) == 6

    module.run(Slow(), clock, 10.0, told)  # type: ignore[arg-type]
    assert starts == pytest.approx([0.0, 0.1, 0.5, 0.6, 0.73, 0.8])


class _Told:
    done = False

    def is_set(self) -> bool:
        return self.done


# As a process


@contextlib.contextmanager
def linked(ready: dict[str, Any]) -> Iterator[tuple[NodeSource, NodeSink]]:
    config = Config(sub_endpoint=ready["obs_endpoint"], pub_endpoint=ready["action_endpoint"])
    source = link.source(config, ROBOT, MonotonicClock())
    sink = link.sink(config, ROBOT, MonotonicClock())
    source.connect()
    sink.connect()
    with contextlib.closing(source), contextlib.closing(sink):
        yield source, sink


def observed(source: NodeSource, wanted: Callable[[Observation], bool]) -> Observation:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        observation = source.receive(1.0)
        if observation is not None and wanted(observation):
            return observation
    raise AssertionError("it was not observed")


def test_a_real_client_sees_it_and_moves_it(start: Any) -> None:
    ready = start("runtime.simulation.node", "--robot", "agilex_piper", *SMALL).ready

    def arrived(observation: Observation) -> bool:
        sink.send(RobotCommand(AWAY.astype(np.float32), 0, 0.0))
        return bool(np.abs(observation.qpos - AWAY).max() < 1e-3)

    with linked(ready) as (source, sink):
        observation = observed(source, arrived)
        assert source.status.master == sink.master
        assert source.status.holding is False
        observed(source, lambda _: source.status.holding is True)
    rgb = observation.pictures["cam_high"]
    assert rgb[-2, 10].tolist() == [255, 0, 0]
    assert rgb[-2, -10].tolist() == [0, 0, 255]
    assert observation.eef is not None


@pytest.mark.exhaustive
def test_a_restart_on_the_same_ports_with_a_smaller_clock_is_noticed(start: Any) -> None:
    first = start("runtime.simulation.node", "--robot", "agilex_piper", *SMALL)
    ready = first.ready
    with linked(ready) as (source, _):
        observed(source, lambda _: True)
        first.process.send_signal(signal.SIGKILL)
        first.process.wait()
        ports = ["--obs-endpoint", ready["obs_endpoint"], "--action-endpoint", ready["action_endpoint"]]
        size = ["--width", "96", "--height", "60"]
        start("runtime.simulation.node", "--robot", "agilex_piper", *ports, *size, "--clock-offset", "-1000")
        observation = observed(source, lambda _: source.faults().get("clock_backwards") == 1)
        assert observation.arrived - observation.captured["joints"] < 1.0


def test_its_faults_are_counted_by_the_client_and_end_nothing(start: Any) -> None:
    ready = start(
        "runtime.simulation.node", "--robot", "agilex_piper", *SMALL, "--malformed-every", "2"
    ).ready
    with linked(ready) as (source, _):
        observed(source, lambda _: source.faults().get("malformed", 0) >= 3)
        assert "msgpack" in source.last_fault


def test_two_clients_at_one_node_one_rules_and_the_other_is_told(start: Any) -> None:
    ready = start("runtime.simulation.node", "--robot", "agilex_piper", *SMALL).ready
    with linked(ready) as (source, sink), linked(ready) as (_, rival):

        def refused(_: Observation) -> bool:
            sink.send(RobotCommand(HOME.astype(np.float32), 0, 0.0))
            if source.status.master == sink.master:
                rival.send(RobotCommand(AWAY.astype(np.float32), 0, 0.0))
            return source.faults().get("node_refused.other_master", 0) >= 5

        observation = observed(source, refused)
        assert source.status.master == sink.master
    np.testing.assert_allclose(observation.qpos, HOME, atol=1e-5)


def test_it_writes_its_addresses_and_ends_on_sigterm(start: Any, tmp_path: Path) -> None:
    file = tmp_path / "ready.json"
    standin = start("runtime.simulation.node", "--robot", "agilex_piper", *SMALL, "--ready-file", str(file))
    assert json.loads(file.read_text()) == standin.ready
    assert list(tmp_path.iterdir()) == [file]
    standin.process.terminate()
    assert standin.process.wait(PATIENCE_S) == 0


def test_it_ends_when_its_lifeline_ends(start: Any) -> None:
    process = start("runtime.simulation.node", "--robot", "agilex_piper", *SMALL).process
    process.stdin.close()
    assert process.wait(PATIENCE_S) == 0


@pytest.mark.some(1)
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--robot", "no_such_robot"], "no_such_robot"),
        (["--robot", "agilex_piper", *FREE, "--drop-camera", "x"], "has no camera 'x'"),
        (["--robot", "agilex_piper", *FREE, "--rate", "0"], "0 is not above zero"),
        (["--robot", "agilex_piper", *FREE, "--start-pose", "x"], "has no pose 'x'; it has home, ready"),
        (["--robot", "agilex_piper", *FREE, "--bench", "tabletop", "--blocks", "0"], "0 blocks by seed 0"),
        (["--robot", "agilex_piper", *FREE, "--bench", "contact", "--blocks", "0"], "0 blocks by seed 0"),
        (["--robot", "agilex_piper", *FREE, "--groups", "left_arm,tail"], "tail"),
    ],
)
def test_a_wrong_option_ends_it_with_a_sentence(arguments: list[str], says: str) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "runtime.simulation.node", *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert ended.returncode == 2
    assert says in ended.stderr
    assert "Traceback" not in ended.stderr
