"""The states of a tunnel, around an ssh that does what the test says, on the test's clock."""

from __future__ import annotations

import threading
from collections import deque

import pytest

from runtime.policies.tunnel.keeper import TunnelKeeper
from tests.processes import PATIENCE_S


class FakeSsh:
    """Lives, listens and says what it is told."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.said: deque[str] = deque()
        self.refusal, self.refusals = "", 0
        self.code: int | None = None
        self.up = self.ended = False

    def poll(self) -> int | None:
        return self.code

    def is_listening(self) -> bool:
        return self.up

    def terminate(self) -> None:
        self.ended = True


class World:
    def __init__(self) -> None:
        self.now, self.started, self.fault = 100.0, [], None
        self.keeper = TunnelKeeper("gpu", self._start, 10.0, lambda: self.now)  # type: ignore[arg-type]

    started: list[FakeSsh]
    fault: OSError | None

    def _start(self) -> FakeSsh:
        if self.fault is not None:
            raise self.fault
        self.started.append(FakeSsh(40001 + len(self.started)))
        return self.started[-1]

    @property
    def ssh(self) -> FakeSsh:
        return self.started[-1]

    @property
    def status(self):
        return self.keeper.status

    def look(self, seconds: float = 0.0) -> None:
        self.now += seconds
        self.keeper.poll()

    def come_up(self) -> None:
        count = len(self.started)
        while len(self.started) == count:
            self.look(0.05)
        self.ssh.up = True
        self.look()

    def end(self, *said: str) -> None:
        self.ssh.said.extend(said)
        self.ssh.code = 255
        self.look()


@pytest.fixture
def world() -> World:
    return World()


def test_it_is_up_when_its_own_ssh_listens_and_no_sooner(world: World) -> None:
    world.look()
    world.look(1.0)
    assert (world.status.up, world.status.port) == (False, 0)
    world.ssh.up = True
    world.look(1.0)
    assert (world.status.up, world.status.port, world.status.failures) == (True, 40001, 0)
    world.look(1000.0)
    assert len(world.started) == 1
    assert world.keeper.duration(world.status) == pytest.approx(1000.0)


def test_a_near_end_is_its_own_only_as_long_as_its_ssh_listens_there(world: World) -> None:
    assert not world.keeper.owns_port(0)
    world.come_up()
    assert world.keeper.owns_port(40001)
    assert not world.keeper.owns_port(40002)
    world.ssh.up = False  # it has ended, and nobody has looked yet
    assert world.status.up
    assert not world.keeper.owns_port(40001)


def test_an_ssh_that_ends_is_down_since_then_with_what_it_said(world: World) -> None:
    world.come_up()
    world.now += 50.0
    world.end("Connection to gpu closed by remote host.")
    status = world.status
    assert (status.up, status.port, status.failures) == (False, 0, 1)
    assert status.why == "Connection to gpu closed by remote host."
    assert world.ssh.ended
    world.look(3.0)
    assert world.keeper.duration(status) == pytest.approx(3.0)


def test_it_is_down_since_the_first_of_several_failures(world: World) -> None:
    world.come_up()
    world.end("first")
    begun = world.now
    for _ in range(4):
        world.look(10.0)
        world.end("again")
    assert world.status.since == begun
    assert (world.status.why, world.status.failures) == ("again", 5)


def test_another_is_started_sooner_at_first_and_then_less_and_less_often(world: World) -> None:
    world.look()
    pauses = []
    for _ in range(8):
        world.end("no")
        begun, count = world.now, len(world.started)
        while len(world.started) == count:
            world.look(0.05)
        pauses.append(world.now - begun)
    assert pauses == pytest.approx([0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0], abs=0.06)


def test_a_tunnel_that_lasted_has_earned_the_shortest_pause_again(world: World) -> None:
    world.come_up()
    for lasted, pause in ((1.0, 0.2), (9.0, 0.4), (9.0, 0.8), (10.5, 0.2), (1.0, 0.4)):
        world.now += lasted
        world.end("gone")
        broken = world.now
        world.come_up()
        assert world.now - broken == pytest.approx(pause, abs=0.06)


def test_a_port_that_others_were_quicker_to_take_is_no_failure_and_another_is_tried_at_once(
    world: World,
) -> None:
    world.look()
    world.end("bind [127.0.0.1]:40001: Address already in use", "Could not request local forwarding.")
    assert (world.status.failures, world.ssh.ended) == (0, True)
    world.look()
    assert len(world.started) == 2
    world.ssh.up = True
    world.look()
    assert (world.status.up, world.status.port) == (True, 40002)


def test_where_no_port_can_be_had_it_is_a_failure_after_all(world: World) -> None:
    world.look()
    for _ in range(6):
        assert world.status.failures == 0
        world.end("channel_setup_fwd_listener_tcpip: cannot listen to port: 40001")
        world.look()
    assert world.status.failures == 1
    assert len(world.started) == 6


def test_an_ssh_that_is_not_up_in_time_is_ended(world: World) -> None:
    world.look()
    world.ssh.said.append("Authenticating to gpu")
    world.look(9.9)
    assert not world.ssh.ended
    world.look(0.2)
    assert world.ssh.ended
    assert world.status.why == "it was not up within 10 s (Authenticating to gpu)"


def test_an_ssh_that_cannot_be_started_is_a_failure_and_tried_again(world: World) -> None:
    world.fault = OSError(12, "Cannot allocate memory")
    world.look()
    assert world.status.failures == 1
    assert "Cannot allocate memory" in world.status.why
    world.fault = None
    world.look(0.3)
    assert len(world.started) == 1


def test_connections_that_the_far_end_refuses_are_counted_over_every_ssh(world: World) -> None:
    world.come_up()
    world.ssh.refusal, world.ssh.refusals = "connect failed: Connection refused", 2
    world.look()
    world.look()
    assert (world.status.refusals, world.status.refusal) == (2, "connect failed: Connection refused")
    world.end("gone")
    world.come_up()
    world.ssh.refusal, world.ssh.refusals = "administratively prohibited", 1
    world.look()
    assert (world.status.refusals, world.status.refusal) == (3, "administratively prohibited")
    assert world.status.up


def threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name == "tunnel"}


def test_closed_it_ends_its_ssh_and_its_thread_and_says_so_at_once(world: World) -> None:
    before = threads()
    world.keeper.start()
    world.keeper.wait_for(lambda _: bool(world.started), PATIENCE_S)
    world.keeper.close()
    assert (world.status.closed, world.status.why) == (True, "it was closed from our side")
    world.keeper.wait_for(lambda _: threads() <= before, PATIENCE_S)
    assert threads() <= before
    assert all(ssh.ended for ssh in world.started)


def test_a_fault_of_our_own_is_told_to_whoever_waits(world: World) -> None:
    world.fault = ValueError("a bug")  # type: ignore[assignment]
    world.keeper.start()
    status = world.keeper.wait_for(lambda now: now.closed, PATIENCE_S)
    assert status.closed
    assert status.why == "it is not kept any more (ValueError: a bug)"
