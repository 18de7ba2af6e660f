"""Every fault of a robot against every transport: counted by name, said in a sentence, and the next frame comes."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator

import psutil
import pytest

from runtime.core.errors import TransportError
from runtime.core.types import Observation
from runtime.transports.base import Source
from tests.conformance.robots_played import TRANSPORTS, Played, mark_of, played
from tests.processes import PATIENCE_S, eventually, joined

IDLE_FRAMES = 1000

pytestmark = pytest.mark.usefixtures("no_thread_is_left")
on_every_transport = pytest.mark.parametrize("robot", TRANSPORTS, indirect=True)


@pytest.fixture
def robot(request: pytest.FixtureRequest) -> Iterator[Played]:
    with played(request.param, request) as made:
        yield made


def seen(robot: Played, mark: int, source: Source | None = None, fault: str = "") -> Observation:
    """Play until a frame with this mark comes; `fault` spoils it."""

    def found() -> Observation | None:
        robot.play(mark, fault)
        began = time.monotonic()
        observation = (source or robot.source).receive(0.05)
        assert time.monotonic() - began < PATIENCE_S, "it hung"
        return observation if observation is not None and mark_of(observation) == mark else None

    return eventually(found, f"a frame with mark {mark}")


def said(robot: Played, words: str, act: Callable[[], object] = lambda: None) -> str:
    """The sentence among the news that has these words, while `act` goes on."""
    told: list[str] = []

    def found() -> str:
        act()
        robot.source.receive(0.01)
        told.extend(event.text for event in robot.source.pop_events())
        return next((text for text in told if words in text), "")

    return eventually(found, f"news with {words!r}; told: {told}")


CASES = [
    pytest.param(name, fault, id=f"{name}-{fault}")
    for name, (kind, _) in TRANSPORTS.items()
    for fault in kind.faults
]


@pytest.mark.some(3)
@pytest.mark.parametrize(("robot", "fault"), CASES, indirect=["robot"])
def test_a_fault_is_counted_by_name_and_the_next_frame_comes(robot: Played, fault: str) -> None:
    name, words = robot.faults[fault]
    seen(robot, 1)

    def counted() -> bool:
        robot.play(2, fault)
        observation = robot.source.receive(0.02)
        assert observation is None or mark_of(observation) == 1, "a spoilt frame was delivered"
        robot.source.pop_events()
        return robot.source.faults().get(name, 0) >= (1 if name.startswith("stalled") else 2)

    eventually(counted, name)
    assert words in robot.source.describe_fault(name)
    seen(robot, 3)


# Both generations of ROS have one source: what its sentences are is asked of the quicker one.
WAITED_FOR = [case for case in CASES if case.values[0] != "ros1" or case.values[1] in ("noise", "truncated")]


@pytest.mark.exhaustive
@pytest.mark.parametrize(("robot", "fault"), WAITED_FOR, indirect=["robot"])
def test_a_robot_that_was_never_right_is_waited_for_with_the_reason(robot: Played, fault: str) -> None:
    words = robot.faults[fault].words
    sentence = said(robot, words, lambda: robot.play(1, fault))
    assert sentence.startswith("waiting for ")
    assert robot.source.receive(0.0) is None
    seen(robot, 2)


def test_every_transport_plays_every_fault_or_says_why_it_cannot() -> None:
    known = set().union(*(kind.faults for kind, _ in TRANSPORTS.values())) - {"joint_names"}
    for kind, _ in TRANSPORTS.values():
        assert known - set(kind.faults) == set(kind.none)


@on_every_transport
def test_a_robot_that_is_mute_is_named(robot: Played) -> None:
    sentence = said(robot, "waiting for")
    assert ": no message for " in sentence or ": nothing " in sentence
    assert robot.source.receive(0.05) is None
    assert robot.source.pop_events() == [], "said twice"


@on_every_transport
def test_a_robot_that_falls_silent_is_named_once_and_again_after_it_was_there(robot: Played) -> None:
    for mark in (1, 2):
        seen(robot, mark)
        assert "waiting for " in said(robot, ": nothing for ")
    assert robot.source.receive(0.0) is None


@pytest.mark.some(1)
@on_every_transport
def test_a_robot_that_restarts_is_heard_again(robot: Played) -> None:
    seen(robot, 1)
    robot.offset = -1000.0  # its clock began anew
    robot.restart()
    observation = seen(robot, 2)
    assert all(0 <= observation.arrived - at < 5 for at in observation.captured.values())
    assert robot.source.faults()["clock_backwards"] == 1


@pytest.mark.some(2)
@on_every_transport
@pytest.mark.parametrize(
    ("jump", "name"), [(-5.0, "clock_backwards"), (5.0, "clock_forwards"), (1e6, "clock_forwards")]
)
def test_a_clock_that_jumps_is_named_and_ages_nothing(robot: Played, jump: float, name: str) -> None:
    seen(robot, 1)
    robot.offset = jump
    for mark in (2, 3):
        observation = seen(robot, mark)
    assert all(0 <= observation.arrived - at < 1 for at in observation.captured.values())
    assert robot.source.faults()[name] >= 1
    assert "clock" in robot.source.describe_fault(name)


@pytest.mark.some(1)
@on_every_transport
def test_a_frozen_camera_is_named_while_all_else_goes_on(
    robot: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("runtime.transports.frozen_cameras.FROZEN_S", 0.1)
    still = robot.picture()
    monkeypatch.setattr(robot, "picture", lambda: still)
    mark = 0
    while not any(name.startswith("frozen_") for name in robot.source.faults()):
        mark = mark % 200 + 1
        observation = seen(robot, mark)
    assert min(observation.captured.values()) < observation.captured["joints"]
    assert "shows the same picture" in robot.source.describe_fault("frozen_cam_wrist")


@pytest.mark.exhaustive
@on_every_transport
def test_frames_that_come_while_nobody_reads_are_not_kept(robot: Played) -> None:
    """1,000 of 115 kB: who kept them would have grown by as much."""
    seen(robot, 1)
    robot.size = (120, 160)
    process = psutil.Process(os.getpid())
    for _ in range(100):
        robot.play(5)
    before = process.memory_info().rss
    for _ in range(IDLE_FRAMES):
        robot.play(6)
        time.sleep(0.002)  # else most are dropped on the way
    assert process.memory_info().rss - before < 60e6
    observation = seen(robot, 7)
    assert observation.arrived - observation.captured["joints"] < 5


@pytest.mark.exhaustive
@on_every_transport
def test_a_flood_of_noise_ends_nothing(robot: Played) -> None:
    seen(robot, 1)
    noise = [fault for fault in ("noise", "truncated", "not_finite") if fault in robot.faults]
    for number in range(600):
        robot.play(2, noise[number % len(noise)])
    seen(robot, 3)
    assert len(robot.source.faults()) < 20, "one name each, however many"


@pytest.mark.some(1)
@on_every_transport
def test_readers_of_one_robot_do_not_steal_from_each_other(robot: Played) -> None:
    with contextlib.closing(robot.another()) as other:
        for mark in (1, 2):
            seen(robot, mark, other)
            seen(robot, mark)


@pytest.mark.some(1)
@on_every_transport
def test_who_waits_is_let_go_when_it_is_closed_and_it_can_be_connected_again(robot: Played) -> None:
    def wait() -> None:
        with contextlib.suppress(TransportError):  # it may be closed before it is asked
            robot.source.receive(0.5)

    waiting = threading.Thread(target=wait)
    waiting.start()
    robot.source.close()
    joined(waiting)
    robot.source.connect()
    seen(robot, 4)
