"""Every fault of a GR00T server: one named error, one helpful sentence, within the deadline, and no thread left."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import Any

import numpy as np
import pytest

import robots
from runtime.clock import MonotonicClock
from runtime.errors import PolicyError, PolicyLostError
from runtime.policies import gr00t
from runtime.sim.faults import Fault
from runtime.sim.gr00t_server import Gr00tBehaviour, Gr00tServer
from runtime.types import Observation

ROBOT = robots.load("agilex_piper")
PARTS = {group.name: list(range(group.slice.start, group.slice.stop)) for group in ROBOT.groups}
WAITING = ("mute_on_connect", "mute_on_infer", "late_reply")  # faults that only a deadline ends
DEADLINE = 0.4  # s, for these; others are noticed at once, also by a busy machine
PATIENCE = 30.0
FAULTS: list[tuple[str, type[PolicyError], str]] = [
    ("mute_on_connect", PolicyLostError, "did not send an answer to get_modality_config within"),
    ("mute_on_infer:0", PolicyLostError, "did not send an answer to get_action within 0.4 s"),
    ("mute_on_infer:1", PolicyLostError, "did not send an answer to get_action within 0.4 s"),
    ("late_reply:0.8", PolicyLostError, "the connection is dropped"),
    ("close_mid_reply:0", PolicyLostError, "closed the connection before an answer"),
    ("close_mid_reply:1", PolicyLostError, "closed the connection before an answer"),
    ("wrong_dim", PolicyError, "rows of 6 numbers; this robot needs 7"),
    ("nan", PolicyError, "action 'left_arm' has nan at row 3, column 2"),
    ("empty", PolicyError, "action 'left_arm' is empty"),
    ("bad_array_dialect", PolicyError, "openpi dialect"),
    ("object_array", PolicyError, "not the GR00T protocol: .*objects"),
    ("exception", PolicyError, "CUDA out of memory"),
    ("two_batches", PolicyError, r"shape \[2, 50, 7\]"),
    ("unknown_endpoint", PolicyError, "has no endpoint 'get_modality_config'"),
    ("error_bytes", PolicyError, "answers get_action with ERROR"),
    ("malformed", PolicyError, "not one msgpack message"),
    ("two_frames", PolicyError, "2 frames; expected one"),
    ("missing_key", PolicyError, r"no action 'left_arm'; it has (action\.)?right_arm"),
    ("uneven", PolicyError, "different numbers of rows: left_arm 49, right_arm 50"),
]
UNBATCHED = {"two_batches"}  # N1.5 has no batch axis


@pytest.fixture
def observation() -> Observation:
    pictures = {camera.key: np.zeros((24, 32, 3), np.uint8) for camera in ROBOT.cameras}
    return Observation(1, 0.0, {}, np.full(ROBOT.dim, 0.1, np.float32), pictures, prompt="pick")


CASES = [
    pytest.param(version, *fault, id=f"{version}-{fault[0]}")
    for version in ("n1.5", "n1.6", "n1.7")
    for fault in FAULTS
    if version != "n1.5" or fault[0] not in UNBATCHED
]


@pytest.mark.parametrize(("version", "fault", "error", "says"), CASES)
def test_a_fault_is_one_helpful_sentence_in_time(
    version: Any, fault: str, error: type[PolicyError], says: str, observation: Observation
) -> None:
    name, _, argument = fault.partition(":")
    deadline = DEADLINE if name in WAITING else PATIENCE
    threads = threading.active_count()
    behaviour = Gr00tBehaviour(version, fault=Fault(name, argument))
    with contextlib.closing(Gr00tServer(ROBOT, behaviour)) as server:
        settings = gr00t.Config(
            url=str(server.start()["url"]),
            dialect="n1.5" if version == "n1.5" else "nested",
            video={camera.key: camera.key for camera in ROBOT.cameras},
            state=PARTS,
            actions=PARTS,
            connect_deadline=deadline,
            first_inference_deadline=deadline,
            inference_deadline=deadline,
        )
        with contextlib.closing(gr00t.build(settings, ROBOT, MonotonicClock(), 30.0)) as policy:
            told: list[PolicyError] = []
            for _ in range(2):
                started = time.monotonic()
                try:
                    policy.infer(observation)
                except PolicyError as failure:
                    told.append(failure)
                assert time.monotonic() - started < PATIENCE, "it hung"
    assert told, "the fault was not noticed"
    assert isinstance(told[0], error)
    assert (error is PolicyLostError) == isinstance(told[0], PolicyLostError)
    with pytest.raises(PolicyError, match=says):
        raise told[0]
    assert threading.active_count() == threads
