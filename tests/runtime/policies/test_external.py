"""The policy `external` and the robot server's end of it, over a real socket."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zmq

import robots
from runtime.clients.robot_server.exchange import RowExchange
from runtime.core.clock import VirtualClock
from runtime.core.errors import PolicyError, PolicyLostError
from runtime.core.types import Observation
from runtime.policies import external
from runtime.policies.external import Config, ExternalPolicy
from tests.processes import PATIENCE_S

ROBOT = robots.load_robot("agilex_piper")
STANDS = np.clip(np.linspace(-0.2, 0.2, ROBOT.dim), ROBOT.lower, ROBOT.upper)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def exchange(tmp_path: Path, clock: Clock) -> Iterator[RowExchange]:
    made = RowExchange(zmq.Context.instance(), tmp_path / "station", "rows0", clock)
    yield made
    made.close()


@pytest.fixture
def policy(exchange: RowExchange) -> Iterator[ExternalPolicy]:
    made = external.build(
        Config(socket_file=exchange.socket_path, client="theirs", answer_s=10.0), ROBOT, VirtualClock(), 30.0
    )
    yield made
    made.close()


def observation(step: int = 0, commanded: np.ndarray | None = None, **taken: float) -> Observation:
    picture = np.full((4, 6, 3), step, np.uint8)
    return Observation(
        sequence=step,
        arrived=0.0,
        captured={"joints": float(step), **(taken or {"cam_high": float(step)})},
        qpos=STANDS.astype(np.float32),
        pictures=dict.fromkeys(taken or ["cam_high"], picture),
        step=step,
        commanded=commanded,
        prompt="fold",
    )


def test_until_the_first_row_the_robot_stays_at_its_command_and_at_its_reading_where_they_are_far_apart(
    policy: ExternalPolicy,
) -> None:
    grip, arm, far = ROBOT.gripper_dims[0], 1, 2
    commanded = STANDS.copy()
    commanded[[grip, arm, far]] += [0.5, 0.05, 0.5]
    assert policy.connect().name == "theirs"
    rows = policy.infer(observation(commanded=commanded)).actions
    wanted = commanded.copy()
    wanted[far] = STANDS[far]
    np.testing.assert_allclose(rows, np.tile(wanted, (len(rows), 1)), atol=1e-6)
    np.testing.assert_allclose(policy.infer(observation()).actions[0], STANDS, atol=1e-6)


def test_every_request_returns_the_newest_row_until_a_reset(
    policy: ExternalPolicy, exchange: RowExchange
) -> None:
    exchange.set_row(np.full(ROBOT.dim, 0.25, np.float32))
    for _ in range(2):
        assert (policy.infer(observation()).actions == 0.25).all()
    policy.reset()
    np.testing.assert_allclose(policy.infer(observation()).actions[0], STANDS, atol=1e-6)


@pytest.mark.parametrize(
    ("row", "why"),
    [
        (np.zeros(3, np.float32), r"a row of \[3\]"),
        (np.full(ROBOT.dim, np.nan, np.float32), "finite numbers"),
    ],
)
def test_a_row_that_fits_no_robot_is_an_error(
    policy: ExternalPolicy, exchange: RowExchange, row: np.ndarray, why: str
) -> None:
    exchange.set_row(row)
    with pytest.raises(PolicyError, match=why):
        policy.infer(observation())


def test_a_robot_server_that_is_gone_is_a_lost_policy(tmp_path: Path) -> None:
    absent = Config(socket_file=f"{tmp_path}/rows", client="theirs", answer_s=0.05)
    with pytest.raises(PolicyLostError, match=r"theirs: its robot server has not answered for 0\.05 s"):
        external.build(absent, ROBOT, VirtualClock(), 30.0).connect()


def test_the_program_gets_the_newest_picture_of_each_camera_and_each_travels_once(
    policy: ExternalPolicy, exchange: RowExchange, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    travelled: list[list[str]] = []
    request = policy._request
    monkeypatch.setattr(
        policy,
        "_request",
        lambda message: travelled.append(sorted(message.get("pictures", {}))) or request(message),
    )
    both = frozenset(["cam_high", "cam_left_wrist"])
    exchange.begin()
    policy.infer(observation(1, cam_high=1.0, cam_left_wrist=1.0))
    policy.infer(observation(2, cam_high=1.0, cam_left_wrist=2.0))
    newest = exchange.wait_for_observation(both, -1.0, PATIENCE_S)
    assert newest is not None
    assert travelled == [["cam_high", "cam_left_wrist"], ["cam_left_wrist"]]
    assert {key: int(picture[0, 0, 0]) for key, picture in newest.pictures.items()} == {
        "cam_high": 1,
        "cam_left_wrist": 2,
    }
    assert (newest.step, newest.task, newest.captured["cam_left_wrist"]) == (2, "fold", 2.0)
    clock.now = 10.0  # nobody has asked for an observation since
    for step in (3, 4):
        policy.infer(observation(step, cam_high=step, cam_left_wrist=step))
    assert travelled[2:] == [["cam_high", "cam_left_wrist"], []]
    clock.now = 10.1
    assert exchange.wait_for_observation(both, 9.9, 0.0) is None  # its pictures are older than its joints
    for step in (5, 6):  # the first answer wants pictures again
        policy.infer(observation(step, cam_high=step, cam_left_wrist=step))
    newest = exchange.wait_for_observation(both, 9.9, 0.0)
    assert newest is not None
    assert (newest.step, newest.picture_times, newest.pictures["cam_high"][0, 0, 0]) == (
        6,
        dict.fromkeys(both, 6),
        6,
    )
