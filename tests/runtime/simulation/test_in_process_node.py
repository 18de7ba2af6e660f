from __future__ import annotations

import numpy as np
import pytest

import robots
from runtime.core.clock import VirtualClock
from runtime.core.errors import SetupError
from runtime.core.types import Float64, RobotCommand
from runtime.simulation.in_process_node import InProcessNode
from runtime.simulation.node import Node, parser
from runtime.transports.node_messages import MessageRefused

ROBOT = robots.load_robot("agilex_piper")
HOME = ROBOT.poses["home"]
AWAY = np.clip(HOME + 0.2, ROBOT.lower, ROBOT.upper)
TICK = 1 / 30


class Bench:
    """A link to a node with small pictures, on a clock of its own."""

    def __init__(self, *options: str) -> None:
        self.clock = VirtualClock()
        line = ["--robot", "agilex_piper", "--width", "96", "--height", "60", *options]
        self.node = Node(ROBOT, parser().parse_args(line), self.clock)
        self.link = InProcessNode(self.node, ROBOT, self.clock)
        self.link.connect()

    def send(self, target: Float64, step: int = 0) -> None:
        self.link.send(RobotCommand(target.astype(np.float32), step, self.clock.now()))

    def look(self, after: float = TICK):
        self.clock.advance(after)
        return self.link.receive(0.0)


def test_it_delivers_what_the_node_says_and_nothing_twice() -> None:
    bench = Bench()
    first = bench.look()
    assert first.sequence == 1
    np.testing.assert_allclose(first.qpos, HOME)
    assert first.captured["joints"] == first.arrived == bench.clock.now()
    assert set(first.captured) == {"joints", "eef", *first.pictures}
    assert all(picture.shape == (60, 96, 3) for picture in first.pictures.values())
    assert bench.link.receive(0.0) is None
    assert bench.look().sequence == 2


def test_pictures_are_rgb() -> None:
    picture = next(iter(Bench().look().pictures.values()))
    patches = picture[-1, [10, 48, 86]]  # red, green, blue, in this order
    assert patches.argmax(axis=1).tolist() == [0, 1, 2]


def test_a_command_is_obeyed_when_the_node_is_looked_at_next() -> None:
    bench = Bench()
    bench.look()
    bench.send(AWAY)
    moved = bench.look().qpos - HOME
    assert (np.abs(moved)[np.abs(AWAY - HOME) > 0.1] > 0.02).all()
    for _ in range(60):
        bench.send(AWAY)
        seen = bench.look()
    np.testing.assert_allclose(seen.qpos, AWAY, atol=1e-3)


def test_the_nodes_own_gate_judges_commands() -> None:
    bench = Bench()
    bench.look()
    bench.send(np.full(ROBOT.dim, np.nan))
    np.testing.assert_allclose(bench.look().qpos, HOME)


def test_a_word_lays_the_bench_anew_and_the_truth_says_so() -> None:
    bench = Bench("--bench", "conveyor", "--start-pose", "ready")
    assert bench.look().truth["reset"] == ""
    bench.link.send_control_word("scene_reset", {"id": "first", "seed": 3})
    truth = bench.look().truth
    assert (truth["reset"], truth["seed"], truth["success"]) == ("first", 3, False)
    assert truth["milestones"] == {"reached": False, "followed": False}


def test_a_message_that_is_none_is_not_swallowed() -> None:
    bench = Bench("--malformed-every", "2")
    bench.look()
    with pytest.raises(MessageRefused):
        bench.look()


def test_a_belt_takes_one_block() -> None:
    with pytest.raises(SetupError, match="--blocks 2 with --bench conveyor: one block rides on the belt"):
        Bench("--bench", "conveyor", "--blocks", "2")
