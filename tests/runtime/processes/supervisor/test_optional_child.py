import logging

import pytest

from runtime.processes.supervisor.optional_child import LONGEST_S, OptionalChild
from tests.processes import PATIENCE_S


class Process:
    def __init__(self):
        self.code = None

    def poll(self):
        return self.code


class World:
    def __init__(self):
        self.now, self.started = 100.0, []
        self.companion = OptionalChild("channel", self._start, lambda: self.now)

    def _start(self):
        self.started.append(Process())
        return self.started[-1]

    def end(self, code=1):
        self.started[-1].code = code
        self.companion.poll()

    def wait(self, seconds):
        self.now += seconds
        self.companion.poll()


@pytest.fixture
def world():
    return World()


def test_who_lives_is_left_alone(world):
    for _ in range(5):
        world.wait(PATIENCE_S)
    assert len(world.started) == 1


def test_who_ends_is_started_again_after_a_pause_with_one_line_in_the_log(world, caplog):
    with caplog.at_level(logging.ERROR):
        world.end(3)
        world.wait(1.9)
        assert len(world.started) == 1
        world.wait(0.2)
    assert len(world.started) == 2
    assert [record.message for record in caplog.records] == ["channel: exited with 3; restart in 2 s"]


def test_who_ends_again_and_again_is_started_less_and_less_often(world):
    pauses = []
    for _ in range(7):
        world.end()
        began = world.now
        count = len(world.started)
        while len(world.started) == count:
            world.wait(1.0)
        pauses.append(world.now - began)
    assert pauses == [2.0, 4.0, 8.0, 16.0, LONGEST_S, LONGEST_S, LONGEST_S]


def test_who_has_lived_for_a_minute_is_soon_back(world):
    for _ in range(4):
        world.end()
        world.wait(LONGEST_S)
    world.wait(PATIENCE_S)
    world.end()
    world.wait(1.0)
    assert len(world.started) == 6
