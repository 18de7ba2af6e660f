"""Commitment, dialect and bundled server together, over a real socket."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import robots
from runtime.core import msgpack_arrays
from runtime.core.clock import MonotonicClock
from runtime.core.errors import PolicyError, PolicyLostError, PolicyTimeout
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.ipc.messages import MergeResult
from runtime.policies import openpi
from runtime.policies.openpi import OpenpiPolicy
from runtime.processes.coordinator.inference.rtc_prefix import RtcPrefix
from runtime.standins.faults import NONE, Fault
from runtime.standins.openpi_server import Behaviour, OpenpiServer
from tests.processes import PATIENCE_S

ROBOT = robots.load_robot("agilex_piper")
DIALECTS = ["prev_action", "openpi_rtc", "kai0", "async_rtc"]
HOME = ROBOT.poses["home"].astype(np.float32)


def seen(step: int, value: float = 0.0) -> Observation:
    return Observation(step, 0.0, {}, HOME + np.float32(value), {}, step=step)


@contextlib.contextmanager
def talking(
    dialect: str, fault: Fault = NONE, served: str | None = None, **settings: Any
) -> Iterator[OpenpiPolicy]:
    behaviour = Behaviour(horizon=40, fault=fault, rtc=served or dialect)  # type: ignore[arg-type]
    with contextlib.closing(OpenpiServer(ROBOT, behaviour)) as server:
        if dialect == "openpi_rtc":
            settings = {"rtc_envelope": {"server_shift": 20}, **settings}
        config = openpi.Config(url=str(server.start()["url"]), rtc=dialect, **settings)  # type: ignore[arg-type]
        with contextlib.closing(openpi.build(config, ROBOT, MonotonicClock(), 30.0)) as policy:
            yield policy


def placed(number: int, step: int, delay: int, count: int) -> MergeResult:
    return MergeResult(
        number, step + delay, delay, step + np.arange(count), run=1, contributions=np.zeros((0, 3))
    )


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("delay", [0, 1, 3, 8])
def test_every_chunk_begins_with_what_the_robot_executes_until_it_arrives(dialect: str, delay: int) -> None:
    """Back to back: a request goes out when the answer before has arrived."""
    held = RtcPrefix(30.0)
    executed: dict[int, np.ndarray] = {}
    step = 100
    with talking(dialect) as policy:
        assert policy.connect().supports_rtc is True
        for number in range(1, 6):
            conditioning = held.conditioning(step, [delay], 0.9, None)
            assert (conditioning is None) == (number == 1)
            # The robot is seen elsewhere each time, so that the server's own plan begins elsewhere too.
            chunk = policy.infer(seen(step, 0.02 * number), conditioning)
            assert (chunk.model_actions is None) == (dialect == "kai0")  # which is given the robot's numbers
            assert chunk.model_actions is None or chunk.model_actions.shape == (40, 32)
            for ahead in range(delay if number > 1 else 0):
                np.testing.assert_allclose(chunk.actions[ahead], executed[step + ahead], atol=1e-5)
            held.add_chunk(number, chunk, step)
            held.on_merged(placed(number, step, delay, 40))
            executed.update({step + ahead: row for ahead, row in enumerate(chunk.actions) if ahead >= delay})
            step += max(1, delay)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_without_anything_to_continue_the_server_answers_as_a_plain_one_does(dialect: str) -> None:
    with talking("none", served="none") as plain, talking(dialect) as policy:
        assert plain.connect().supports_rtc is False
        expected = plain.infer(seen(0))
        assert expected.model_actions is None
        np.testing.assert_array_equal(policy.infer(seen(0)).actions, expected.actions)


def test_a_plain_request_is_understood_by_the_server_of_the_flat_dialect() -> None:
    with talking("none", served="prev_action") as policy:
        assert policy.connect().supports_rtc is False
        assert policy.infer(seen(0)).actions.shape == (40, ROBOT.dim)


# Servers without RTC, or of another dialect


def test_a_server_that_says_nothing_of_rtc_leaves_it_open() -> None:
    with talking("prev_action", served="none") as policy:
        assert policy.connect().supports_rtc is None


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_server_that_says_that_it_continues_nothing_is_believed(dialect: str) -> None:
    with talking(dialect, Fault("no_rtc")) as policy:
        assert policy.connect().supports_rtc is False


@pytest.mark.parametrize(
    ("dialect", "served", "fault", "says"),
    [
        ("async_rtc", "prev_action", NONE, "have no async_rtc map, only name, action_horizon, rtc"),
        ("async_rtc", "none", NONE, "have no async_rtc map"),
        ("prev_action", "async_rtc", NONE, "allowed with this server: 'async_rtc'"),
        ("none", "async_rtc", NONE, "allowed with this server: 'async_rtc'"),
        ("async_rtc", "async_rtc", Fault("envelope_version", "3"), "version 3; needed: .* version 2"),
    ],
)
def test_a_server_of_another_dialect_is_refused_on_connect(
    dialect: str, served: str, fault: Fault, says: str
) -> None:
    with talking(dialect, fault, served) as policy, pytest.raises(PolicyError, match=says) as raised:
        policy.connect()
    assert not isinstance(raised.value, PolicyLostError)


# What goes wrong with an answer


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("request_id", "request_id 1, asked was 0"),
        ("exception", "reports an error: RuntimeError: CUDA out of memory"),
    ],
)
def test_an_answer_that_is_none_is_an_error_and_the_connection_is_dropped(fault: str, says: str) -> None:
    with talking("async_rtc", Fault(fault)) as policy:
        policy.connect()
        with pytest.raises(PolicyError, match=says) as raised:
            policy.infer(seen(0))
        assert not isinstance(raised.value, PolicyLostError)
        assert not policy._link.is_open


def test_a_request_that_the_server_cannot_read_is_answered_with_an_error_without_a_number() -> None:
    with talking("async_rtc") as policy:
        policy.connect()
        with policy._lock:
            reply = msgpack_arrays.unpack(policy._link.exchange(msgpack_arrays.pack({"state": 1}), 10.0))
    assert reply["request_id"] is None
    assert "expected 'openpi-async-rtc' version 2" in reply["error"]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_one_late_reply_is_a_lost_policy_and_the_next_request_is_answered_rightly(dialect: str) -> None:
    settings = {"first_inference_deadline": 10.0, "inference_deadline": 0.5}
    left = Conditioning(np.tile(HOME, (40, 1)), 5, 3, 40)
    with talking(dialect, Fault("late_reply", "4"), **settings) as policy:
        policy.infer(seen(0))
        with pytest.raises(PolicyTimeout):
            policy.infer(seen(10, 0.1), left)
        answers = [_answered(policy, value) for value in (0.2, 0.3)]
    for chunk, value in zip(answers, (0.2, 0.3), strict=True):
        assert np.abs(chunk.actions[0] - np.clip(HOME + value, ROBOT.lower, ROBOT.upper)).max() < 0.05


def _answered(policy: OpenpiPolicy, value: float) -> ActionChunk:
    """The answer, within the patience of a run: the server may still be at the request that nobody waits for."""
    for _ in range(20):
        with contextlib.suppress(PolicyLostError):
            return policy.infer(seen(20, value))
    raise AssertionError("the policy did not come back")


def test_a_reset_with_a_reply_in_flight_leaves_nothing_to_continue() -> None:
    held = RtcPrefix(30.0)
    with talking("prev_action", Fault("late_reply", "0.3")) as policy, ThreadPoolExecutor(1) as pool:
        policy.connect()
        policy.infer(seen(0))
        begun = threading.Event()

        def ask(generation: int) -> tuple[int, ActionChunk]:
            begun.set()
            return generation, policy.infer(seen(10))

        flight = pool.submit(ask, held.generation)
        assert begun.wait(PATIENCE_S)
        held.clear()
        policy.reset()
        generation, chunk = flight.result(PATIENCE_S)
        held.add_chunk(2, chunk, 10, generation=generation)
        held.on_merged(placed(2, 10, 9, 40))
        conditioning = held.conditioning(20, [9], 0.9, None)
        assert conditioning is None
        assert "prev_action" not in policy._dialect.wrap(policy.request(seen(20)), conditioning)
