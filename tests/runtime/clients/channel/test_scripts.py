import pytest

from runtime.clients.channel import scripts as module
from runtime.clients.channel.scripts import ScriptActivity, Scripts
from runtime.clients.client import Refused
from runtime.core.errors import TransportError


class Client:
    """Writes down what is asked of it; a fault is raised instead."""

    def __init__(self, holder):
        self.holder, self.done, self.fault = holder, [], None

    def renew(self):
        self._do("renew")

    def release(self):
        self._do("give_up")

    def close(self):
        self._do("close")

    def _do(self, what):
        self.done.append(what)
        if self.fault:
            raise self.fault


class World:
    def __init__(self):
        self.now, self.made = 0.0, {}
        self.lives = ScriptActivity(lambda: self.now)
        self.scripts = Scripts(self._open, self.lives, 10.0)

    def _open(self, holder):
        self.made[holder] = Client(holder)
        return self.made[holder]

    def holding(self, holder):
        script = self.scripts.get_or_create(holder)
        script.holds = True
        self.lives.record(holder)
        return script


@pytest.fixture
def world():
    return World()


def test_a_lease_is_kept_as_long_as_its_script_speaks(world):
    world.holding("a")
    for _ in range(5):
        world.now += 9.0
        world.lives.record("a")
        assert world.scripts.poll() == []
    assert world.made["a"].done == ["renew"] * 5


def test_the_lease_of_a_silent_script_is_given_up_once(world):
    script = world.holding("a")
    world.now += 10.5
    (told,) = world.scripts.poll()
    assert told == "a: no message for 10.5 s; its lease has ended"
    assert not script.holds
    assert world.scripts.poll() == []
    assert world.made["a"].done == ["give_up"]


def test_another_script_does_not_keep_it(world):
    world.holding("a")
    world.now += 10.5
    world.lives.record("b")
    assert len(world.scripts.poll()) == 1


def test_a_script_without_a_lease_is_left_alone(world):
    world.scripts.get_or_create("a")
    world.now += 100.0
    assert world.scripts.poll() == []
    assert world.made["a"].done == []


def test_a_lease_that_was_taken_away_is_told_and_not_claimed_again(world):
    script = world.holding("a")
    world.made["a"].fault = Refused("anna holds the lease")
    assert world.scripts.poll() == ["a has the lease no longer: anna holds the lease"]
    assert not script.holds


def test_a_station_that_does_not_answer_is_asked_again_while_the_script_lives(world):
    script = world.holding("a")
    world.made["a"].fault = TransportError("no answer")
    assert world.scripts.poll() == []
    assert script.holds
    world.now += 11.0
    assert world.scripts.poll() == ["a: no answer"]
    assert not script.holds


def test_who_has_never_spoken_is_none_of_the_channel(world):
    world.lives.record("a")
    assert world.lives.is_known("a")
    assert not world.lives.is_known("browser:anna")
    assert world.lives.silence("browser:anna") == float("inf")


def test_old_scripts_are_forgotten_but_not_who_holds(world, monkeypatch):
    monkeypatch.setattr(module, "KEPT", 3)
    world.holding("keeper")
    for number in range(6):
        world.scripts.get_or_create(str(number))
    closed = [name for name, client in world.made.items() if client.done == ["close"]]
    assert closed == ["0", "1", "2"]
    assert world.scripts.get_or_create("keeper").holds
    world.scripts.close()
    assert all(client.done[-1] == "close" for client in world.made.values())
