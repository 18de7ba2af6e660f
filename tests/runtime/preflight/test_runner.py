"""A preflight as a whole: what it asks, what it notes, and that it ends."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from runtime.core.clock import VirtualClock
from runtime.core.errors import ConfigurationError
from runtime.core.plugins import variants
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.policies.base import Policy, PolicyInfo
from runtime.preflight.report import Report, truncate_value
from runtime.preflight.runner import PreflightRunner
from runtime.preflight.verdict import PreflightStage, PreflightVerdict
from runtime.preflight.virtual_robot import VirtualRobot, noise_images
from runtime.station.preflight_child import default_deadline
from tests.processes import PATIENCE_S
from tests.runtime.policies.peers import FRANKA
from tests.runtime.preflight.bench import WIRES, planned

MOCK = replace(WIRES["openpi"], settings={"kind": "mock"})


class Stub(Policy):
    """Answers what the test says, and keeps what it was shown."""

    def __init__(self, rows: Any = None, info: PolicyInfo | None = None) -> None:
        self.rows = np.tile(FRANKA.poses["home"], (10, 1)) if rows is None else np.asarray(rows)
        self.info = info or PolicyInfo("stub", horizon=len(self.rows))
        self.seen: list[Observation] = []
        self.said: list[str] = []
        self.says: dict[str, Any] = {}  # of its chunks
        self.hangs = threading.Event()
        self.hangs.set()

    def connect(self) -> PolicyInfo:
        self.said.append("connect")
        return self.info

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        self.said.append("infer")
        self.seen.append(observation)
        self.hangs.wait(PATIENCE_S)
        return replace(ActionChunk(self.rows.astype(np.float32)), **self.says)

    def reset(self) -> None:
        self.said.append("reset")

    def close(self) -> None:
        self.said.append("close")


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A preflight of a policy of the test's own."""

    def fly(policy: Policy, deadline: float = PATIENCE_S, **tables: Any) -> Report:
        monkeypatch.setattr(variants("runtime.policies")["mock"], "build", lambda *given: policy)
        tables = {"policy": {"kind": "mock"}, **tables}
        return PreflightRunner(planned(MOCK, "", **tables)).run(deadline)

    return fly


def test_it_connects_forgets_asks_twice_and_lets_the_server_forget_it(flown: Any) -> None:
    policy = Stub()
    report = flown(policy)
    assert report.ok, report.sentence
    assert policy.said == ["connect", "reset", "infer", "infer", "reset", "close"]
    assert report.endpoint == ""
    assert report.notes == ()


def test_the_policy_is_shown_the_robot_at_its_pose_with_grey_pictures(flown: Any) -> None:
    policy = Stub()
    flown(
        policy,
        setup={"pose": "home"},
        cameras={"cam_high": {"kind": "file", "path": "x.mp4", "size": [32, 24]}},
    )
    first, second = policy.seen
    assert np.allclose(first.qpos, FRANKA.poses["home"])
    assert first.prompt == "pick the block"
    assert second.sequence == first.sequence + 1
    assert second.step >= first.step >= 0
    assert first.eef is not None
    assert first.eef.shape == (FRANKA.eef_dim,)
    assert (
        set(first.pictures) == {camera.key for camera in FRANKA.cameras} == set(first.captured) - {"joints"}
    )
    assert first.pictures["cam_high"].shape == (24, 32, 3)
    assert all(
        picture.dtype == np.uint8 and 110 < picture.mean() < 146 for picture in first.pictures.values()
    )
    assert all(picture.std() > 0 for picture in first.pictures.values())


def test_what_it_is_shown_is_the_same_every_time() -> None:
    spec = planned(MOCK, "", policy={"kind": "mock"})
    once, again = noise_images(spec), noise_images(spec)
    assert all(np.array_equal(once[key], again[key]) for key in once)
    subject = VirtualRobot(spec, VirtualClock(5.0))
    assert subject.commanded() is None
    assert set(subject.latest("go").captured.values()) == {5.0}


def test_what_works_and_is_worth_knowing_is_noted(flown: Any) -> None:
    rows = np.tile(FRANKA.poses["home"], (10, 1))
    rows[:4, 0] = FRANKA.upper[0] + 1.0
    report = flown(Stub(rows, PolicyInfo("stub", horizon=20)))
    assert report.ok
    assert report.chunk is not None
    assert report.chunk.beyond_limits == 4
    assert report.chunk.first_joint == FRANKA.joint_names[0]
    assert [note.partition(" ")[0] for note in report.notes] == ["the", "4", "the"]
    assert "20 rows per answer and gave 10" in report.notes[2]


@pytest.mark.parametrize(
    ("relative", "noted"),
    [
        (None, "it is not declared whether the model's own rows are absolute"),
        (True, "are not continued"),
        (False, ""),
    ],
)
@pytest.mark.parametrize("kind", ["rtc", "async"])
def test_with_rtc_it_is_named_what_of_the_models_own_rows_cannot_be_continued(
    flown: Any, kind: str, relative: bool | None, noted: str
) -> None:
    policy = Stub(info=PolicyInfo("stub", horizon=10, supports_rtc=True))
    policy.says = {"model_actions": np.zeros((10, 32), np.float32), "model_relative": relative}
    report = flown(policy, strategy={"kind": kind})
    assert report.ok, report.sentence
    notes = report.notes
    assert len(notes) == (1 if noted and kind == "rtc" else 0)
    assert all(noted in note for note in notes)


def test_a_server_that_cannot_continue_chunks_contradicts_the_strategy(flown: Any) -> None:
    report = flown(Stub(info=PolicyInfo("stub", supports_rtc=False)), strategy={"kind": "rtc"})
    assert (report.verdict, report.stage) == ("contradiction", "metadata")
    assert "strategy 'rtc'" in report.sentence


def test_an_encoder_that_this_machine_lacks_is_named(flown: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*given: object) -> None:
        raise ValueError("there is none")

    monkeypatch.setattr("runtime.recording.encoder_check._code", missing)
    policy = Stub()
    report = flown(policy, recording={"codec": "h264_nvenc"})
    assert report.verdict == "misconfigured"
    assert "recording.codec = 'h264_nvenc' does not work on this machine: there is none" in report.sentence
    assert policy.said == []
    assert flown(policy, recording={"codec": "h264_nvenc", "enabled": False}).ok


def test_fewer_rows_than_are_to_be_executed_contradict_the_strategy(flown: Any) -> None:
    report = flown(Stub(), strategy={"kind": "sync", "execution_horizon": 40})
    assert (report.verdict, report.stage) == ("contradiction", "metadata")
    assert "execution_horizon = 40" in report.sentence


def test_rows_that_the_protocol_let_pass_are_judged_as_by_a_station(flown: Any) -> None:
    wide = flown(Stub(np.zeros((5, 3))))
    assert (wide.verdict, wide.stage) == ("bad_shape", "shape")
    endless = flown(Stub(np.full((5, FRANKA.dim), np.inf)))
    assert (endless.verdict, endless.stage) == ("not_finite", "shape")


def test_a_policy_whose_own_code_fails_is_a_verdict(flown: Any) -> None:
    class Broken(Stub):
        def connect(self) -> PolicyInfo:
            raise ZeroDivisionError("oh")

    report = flown(Broken())
    assert (report.verdict, report.stage) == ("failed", "protocol")
    assert "ZeroDivisionError: oh" in report.sentence


def test_what_does_not_fit_the_robot_is_said_before_anybody_is_asked(flown: Any, monkeypatch: Any) -> None:
    def build(*given: object) -> Policy:
        raise ConfigurationError("policy.cameras = ['cam_9']; allowed: cam_high")

    spec = planned(MOCK, "", policy={"kind": "mock"})
    monkeypatch.setattr(variants("runtime.policies")["mock"], "build", build)
    report = PreflightRunner(spec).run(30.0)
    assert (report.verdict, report.stage, report.calls) == ("misconfigured", "resolve", ())


def test_a_policy_that_never_comes_back_is_a_timeout_at_the_deadline(flown: Any) -> None:
    policy = Stub()
    policy.hangs.clear()
    report = flown(policy, deadline=0.5)
    assert (report.verdict, report.stage) == ("timeout", "infer")
    assert "no end within 0.5 s, while the policy's infer was under way" in report.sentence
    assert policy.said[-1] == "close"
    policy.hangs.set()


def test_the_deadline_is_what_the_policys_own_come_to() -> None:
    spec = planned(WIRES["openpi"], "ws://127.0.0.1:1")
    assert default_deadline(spec.deployment) == pytest.approx(20.0 + 30.0 + 2 * 20.0 + 10.0)
    assert default_deadline(planned(MOCK, "", policy={"kind": "mock"}).deployment) == 10.0


def test_a_report_is_json_whatever_the_server_says(flown: Any) -> None:
    metadata = {
        "weights": np.zeros((3, 4)),
        "blob": b"abc",
        "loss": float("nan"),
        "step": np.int64(7),
        "long": "x" * 1000,
        "many": list(range(100)),
        "keys": {str(n): n for n in range(60)},
        "deep": [[[[[[[[1]]]]]]]],
        3: {"type": int},
    }
    report = flown(Stub(info=PolicyInfo("stub", metadata=metadata)))  # type: ignore[arg-type]
    told = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    said = told["metadata"]
    assert said["weights"] == "array [3, 4] float64"
    assert (said["blob"], said["loss"], said["step"]) == ("3 bytes", "nan", 7)
    assert len(said["long"]) == 303
    assert said["many"][-1] == "... 60 more"
    assert said["keys"]["..."] == "20 more"
    assert "..." in json.dumps(said["deep"])
    assert (told["verdict"], told["stage"], told["ok"]) == ("ok", "space", True)
    assert told["latency_ms"] == told["calls"][3]["ms"]
    assert truncate_value(True) is True
    assert report.lines()[0] == "ok  at space"


def test_a_failed_call_is_shown_with_how_long_it_took() -> None:
    report = PreflightRunner(planned(WIRES["openpi"], "ws://127.0.0.1:1")).run(30.0)
    assert [(call.name, call.ok) for call in report.calls] == [("connect", False)]
    assert report.latency_ms is report.warm_up_ms is None
    assert "(failed)" in "\n".join(report.lines())


def test_a_report_without_a_policy_is_two_lines_and_advice() -> None:
    report = Report(
        PreflightVerdict.MISCONFIGURED,
        PreflightStage.RESOLVE,
        "no such key",
        PreflightVerdict.MISCONFIGURED.advice,
    )
    assert report.lines() == [
        "misconfigured  at resolve",
        "no such key",
        PreflightVerdict.MISCONFIGURED.advice,
    ]
    assert report.to_dict()["chunk"] is None


@pytest.mark.slow
def test_compiling_kinematics_is_not_the_policys_time(flown: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    backend = variants("runtime.kinematics")[
        planned(MOCK, "", policy={"kind": "mock"}).deployment.kinematics.kind
    ]
    build = backend.build
    monkeypatch.setattr(backend, "build", lambda *given: (threading.Event().wait(3.2), build(*given))[1])
    poses = np.concatenate([np.append(arm.pose(FRANKA.poses["home"]), 0.5) for arm in FRANKA.arms])

    class Posed(Stub):
        def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
            return replace(super().infer(observation, conditioning), space="eef")

    report = flown(Posed(np.tile(poses, (5, 1))), deadline=3.0)
    assert report.ok, report.sentence
    assert report.chunk is not None
    assert (report.chunk.space, report.chunk.width, report.chunk.joints) == ("eef", 8, FRANKA.dim)
    assert report.seconds > 3.0
