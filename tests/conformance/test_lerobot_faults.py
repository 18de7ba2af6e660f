"""Every fault of LeRobot's policy server: one named error, one helpful sentence, in time, and nothing is run."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

import numpy as np
import pytest

import robots
from runtime.clock import MonotonicClock
from runtime.errors import PolicyError, PolicyLostError
from runtime.policies import lerobot
from runtime.sim.faults import Fault
from runtime.types import Observation

pytest.importorskip("grpc", reason="the extra lerobot-grpc is not installed")
from runtime.sim.lerobot_server import LerobotBehaviour, LerobotServer

ROBOT = robots.load("agilex_piper")
WAITING = ("mute_on_connect", "mute_on_infer", "late_reply", "exception")  # faults that only a deadline ends
DEADLINE = 0.4  # s, for these; others are noticed at once, also by a busy machine
PATIENCE = 30.0
FAULTS: list[tuple[str, type[PolicyError], str]] = [
    ("mute_on_connect", PolicyLostError, "did not answer Ready within"),
    ("mute_on_infer:0", PolicyLostError, "did not answer GetActions within"),
    ("mute_on_infer:1", PolicyLostError, "did not answer GetActions within"),
    ("late_reply:0.8", PolicyLostError, "the connection is dropped"),
    ("close_mid_reply:0", PolicyLostError, "closed the connection"),
    ("close_mid_reply:1", PolicyLostError, "closed the connection"),
    ("wrong_dim", PolicyError, "rows of 13 numbers; this robot needs 14"),
    ("nan", PolicyError, "nan at row 3, column 2"),
    ("empty", PolicyError, "has no actions"),
    ("exception", PolicyError, "answered with nothing"),
    ("malformed", PolicyError, "not LeRobot's"),
    ("foreign_name", PolicyError, r"names os\.system is refused; allowed: "),
    ("other_step", PolicyError, "steps 1001, 1002"),
    ("other_rate", PolicyError, "rows are at 60 Hz"),
    ("load_fails", PolicyError, "not a folder with a config.json"),
    ("no_name", PolicyError, "policy.server_version"),
]


@pytest.mark.parametrize(("fault", "error", "says"), FAULTS, ids=[name for name, *_ in FAULTS])
def test_a_fault_is_one_helpful_sentence_in_time(
    fault: str, error: type[PolicyError], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where a command that is run would leave its trace
    pictures = {camera.key: np.zeros((24, 32, 3), np.uint8) for camera in ROBOT.cameras}
    observation = Observation(1, 0.0, {}, np.full(ROBOT.dim, 0.1, np.float32), pictures, prompt="pick")
    name, _, argument = fault.partition(":")
    deadline = DEADLINE if name in WAITING else PATIENCE
    with contextlib.closing(
        LerobotServer(ROBOT, LerobotBehaviour(fault=Fault(name, argument), patience=0.1))
    ) as server:
        settings = lerobot.Config(
            url=str(server.start()["url"]),
            accept_pickle=True,
            policy_type="act",
            checkpoint="user/ckpt",
            images={camera.key: camera.key for camera in ROBOT.cameras},
            connect_deadline=deadline,
            first_inference_deadline=deadline,
            inference_deadline=deadline,
        )
        with contextlib.closing(lerobot.build(settings, ROBOT, MonotonicClock(), 30.0)) as policy:
            told: list[PolicyError] = []
            for _ in range(2):
                started = time.monotonic()
                try:
                    policy.infer(observation)
                except PolicyError as failure:
                    told.append(failure)
                assert time.monotonic() - started < PATIENCE, "it hung"
    assert told, "the fault was not noticed"
    assert (error is PolicyLostError) == isinstance(told[0], PolicyLostError)
    with pytest.raises(error, match=says):
        raise told[0]
    assert list(tmp_path.iterdir()) == []
