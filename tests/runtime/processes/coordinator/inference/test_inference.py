from __future__ import annotations

import mmap
import threading
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest

from runtime.core.clock import VirtualClock
from runtime.core.errors import PolicyError, PolicyLostError
from runtime.core.types import ActionChunk, Conditioning, Float32, Observation
from runtime.ipc.messages import MergeResult, Mode, PolicyAnswer, PostedChunk, decode
from runtime.ipc.shared_state import SharedState, SharedStateLayout
from runtime.kinematics.base import IkResult
from runtime.policies.base import Policy, PolicyInfo
from runtime.processes.coordinator.control_queue import ControlQueue
from runtime.processes.coordinator.inference.inference import FaultTimeouts, Inference, Strategy
from runtime.processes.coordinator.inference.policy_observation import PolicyObservation, StalenessLimits
from runtime.processes.coordinator.inference.requests import PolicyRequests
from runtime.processes.coordinator.inference.rtc_prefix import RtcPrefix
from runtime.processes.coordinator.inference.runners import LockstepRunner, Runner, ThreadRunner
from runtime.spaces.conversion import ActionSpaces, ChunkStart, CommandRows
from runtime.strategies import overlap, rtc, sync
from tests.processes import PATIENCE_S

RATE = 30.0
ASYNC = Strategy(overlap.query(overlap.Config()), overlap.Config())
SYNC = Strategy(sync.query(sync.Config()), sync.Config())
PICTURE = np.zeros((5, 5, 3), np.uint8)


class FakePolicy(Policy):
    """Writes down what is asked of it, and answers with the step it was asked about."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.seen: list[Observation] = []
        self.conditionings: list[Conditioning | None] = []
        self.answer: Any = None
        self.open = threading.Event()
        self.open.set()
        self.reached, self.answered = threading.Event(), threading.Event()

    def connect(self) -> PolicyInfo:
        return PolicyInfo("fake")

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        self.calls.append("infer")
        self.seen.append(observation)
        self.conditionings.append(conditioning)
        self.reached.set()
        self.open.wait(PATIENCE_S)
        self.answered.set()
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer or ActionChunk(np.full((4, 2), observation.step, np.float32))

    def reset(self) -> None:
        self.calls.append("reset")

    def close(self) -> None:
        self.calls.append("close")


class FakeSpaces(ActionSpaces):
    """Joint rows pass; a row of NaN is refused as the real ones refuse it."""

    def __init__(self) -> None:
        self.onsets: list[ChunkStart | None] = []

    def to_command(
        self, chunk: ActionChunk, observation: Observation, onset: ChunkStart | None = None
    ) -> CommandRows:
        self.onsets.append(onset)
        if not np.isfinite(chunk.actions).all():
            raise PolicyError("the policy answered with nan")
        rows = chunk.actions.astype(np.float64)
        return CommandRows(rows, np.arange(len(rows)), None)

    def eef_of(self, q: Any, previous: Any = None) -> Float32:
        return np.full(8, q[0], np.float32)


def _async(**parameters: Any) -> Strategy:
    config = overlap.Config(**parameters)
    return Strategy(overlap.query(config), config)


class Desk:
    """Inference with everything around it under the test's hand; media and control are played by it."""

    def __init__(self, runner: Runner | None = None, strategy: Strategy | None = None) -> None:
        layout = SharedStateLayout(2, 8, ("cam",), 300)
        self.shared = SharedState(layout, mmap.mmap(-1, SharedState.size(layout)))
        self.clock = VirtualClock(100.0)
        self.policy = FakePolicy()
        self.runner = runner or LockstepRunner(0)
        policy_observation = PolicyObservation(self.shared, self.clock, StalenessLimits(RATE, 0.2, 0.5))
        self.spaces = FakeSpaces()
        self.requests = PolicyRequests(
            self.policy, "pick", self.spaces, policy_observation, self.runner, self.clock
        )
        self.inference = Inference(
            self.requests,
            strategy or ASYNC,
            self.shared,
            ControlQueue(self.shared),
            self.clock,
            FaultTimeouts(stale=1.0, lost=3.0),
            RtcPrefix(RATE),
        )
        self.sequence = 0

    def observe(self, **changes: Any) -> None:
        self.sequence += 1
        now = self.clock.now()
        self.shared.pictures["cam"].write(self.sequence, PICTURE)
        fields: dict[str, Any] = {
            "sequence": self.sequence,
            "arrived": now,
            "captured": {"joints": now, "cam": now},
            "qpos": np.zeros(2, np.float32),
            "pictures": {},
        }
        self.shared.publish_observation(Observation(**(fields | changes)), {"cam": self.sequence})

    def ticked(self, step: int, remaining: int = 0, **said: Any) -> None:
        """Control has done `step` with the newest observation."""
        status = self.shared.control.read().copy()
        for name, value in said.items():
            status[name] = value
        status["step"], status["planned"], status["sequence"] = step, self.clock.now(), self.sequence
        status["remaining"] = remaining
        self.shared.control.write(status)

    def posted(self) -> list[PostedChunk]:
        found = [decode(payload) for payload in self.shared.rings["orders"].drain()]
        return [message for message in found if isinstance(message, PostedChunk)]

    def merged(self, chunk: int, run: int = 1, delay: int = 3, dropped: str = "") -> None:
        self.inference.on_merged(MergeResult(chunk, 10, delay, np.zeros(4, np.int64), 0, dropped, run))

    def going(self) -> Desk:
        self.observe()
        self.ticked(7)
        self.inference.begin(1, fresh=True)
        return self


@pytest.fixture
def desk() -> Desk:
    return Desk().going()


class GlancingPolicy(FakePolicy):
    """Wants to see something ten times a second."""

    observe_period_s = 0.1

    def __init__(self) -> None:
        super().__init__()
        self.glanced: list[int] = []

    def observe(self, observation: Observation) -> None:
        self.glanced.append(observation.sequence)


def test_who_wants_it_is_shown_what_is_seen_between_requests_and_only_in_a_run() -> None:
    desk = Desk(strategy=SYNC)
    policy = GlancingPolicy()
    desk.requests.policy = policy
    desk.going()
    for _ in range(31):
        desk.ticked(desk.sequence + 7, remaining=5)  # enough is planned: nothing is asked
        desk.inference.poll()
        desk.clock.advance(1 / 30)
        desk.observe()
    assert policy.glanced == [1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31]
    assert policy.calls == []
    desk.inference.pause()
    desk.clock.advance(1.0)
    desk.observe()
    desk.inference.poll()
    assert len(policy.glanced) == 11


def test_what_is_too_old_is_glanced_at_by_nobody_and_a_gap_is_followed_by_no_burst() -> None:
    desk = Desk(strategy=SYNC)
    policy = GlancingPolicy()
    desk.requests.policy = policy
    desk.going()
    desk.ticked(7, remaining=5)
    desk.inference.poll()
    desk.clock.advance(0.4)  # longer than joints may be old
    desk.inference.poll()
    desk.observe()
    for _ in range(4):
        desk.inference.poll()
        desk.clock.advance(0.01)
    assert policy.glanced == [1]
    desk.clock.advance(0.07)
    desk.inference.poll()
    assert policy.glanced == [1, 2]


def test_an_observation_that_control_has_seen_is_of_the_step_that_saw_it(desk: Desk) -> None:
    assert desk.requests.observe().step == 7


def test_a_newer_observation_is_of_the_next_step(desk: Desk) -> None:
    desk.clock.advance(0.02)
    desk.observe()
    assert desk.requests.observe().step == 8


def test_while_control_stalls_an_observation_is_of_the_step_that_will_see_it(desk: Desk) -> None:
    desk.clock.advance(14.5 / RATE)
    desk.observe()
    assert desk.requests.observe().step == 22


def test_an_observation_that_arrived_just_before_a_tick_that_missed_it_is_of_the_next_step(
    desk: Desk,
) -> None:
    desk.observe(arrived=desk.clock.now() - 0.001)
    assert desk.requests.observe().step == 8


def test_the_policy_is_shown_the_task_the_pictures_and_poses(desk: Desk) -> None:
    desk.inference.poll()
    (seen,) = desk.policy.seen
    assert seen.prompt == "pick"
    assert list(seen.pictures) == ["cam"]
    assert seen.eef is not None
    assert seen.eef.shape == (8,)


@pytest.mark.parametrize(
    ("captured", "sentence"),
    [
        ({"joints": -0.3, "cam": 0.0}, r"joints: 0\.30 s old \(limit 0\.2 s\)"),
        ({"joints": 0.0, "cam": -0.6}, r"cam: 0\.60 s old \(limit 0\.5 s\)"),
        ({"joints": 0.0, "cam": float("nan")}, "cam: nothing has arrived yet"),
    ],
)
def test_what_is_too_old_is_named_and_not_shown_to_the_policy(
    captured: dict[str, float], sentence: str
) -> None:
    desk = Desk()
    desk.observe(captured={name: 100.0 + offset for name, offset in captured.items()})
    with pytest.raises(PolicyError, match=sentence):
        desk.requests.send()
    assert desk.policy.calls == []


def test_pictures_may_be_older_than_joints(desk: Desk) -> None:
    desk.observe(captured={"joints": 100.0, "cam": 99.6})
    assert desk.requests.observe().captured["cam"] == 99.6


def test_without_an_observation_or_a_picture_it_says_what_is_missing() -> None:
    desk = Desk()
    with pytest.raises(PolicyError, match="no observation has arrived yet"):
        desk.requests.observe()
    now = desk.clock.now()
    bare = Observation(1, now, {"joints": now}, np.zeros(2, np.float32), {})
    desk.shared.publish_observation(bare, {})
    with pytest.raises(PolicyError, match="no picture has arrived from cam"):
        desk.requests.observe()


def test_an_answer_is_posted_unmerged_with_the_step_of_its_observation(desk: Desk) -> None:
    answer = desk.inference.poll()
    (chunk,) = desk.posted()
    assert (chunk.chunk_id, chunk.run, chunk.observation_step) == (1, 1, 7)
    assert (chunk.rows == 7.0).all()
    assert isinstance(answer, PolicyAnswer)
    assert (answer.chunk_id, answer.run, answer.observation_step, answer.space) == (1, 1, 7, "joint")
    assert answer.source_rows.tolist() == [0, 1, 2, 3]


def test_nothing_is_asked_while_an_answer_is_not_merged_yet(desk: Desk) -> None:
    desk.inference.poll()
    for _ in range(3):
        assert desk.inference.poll() is None
    assert desk.policy.calls.count("infer") == 1
    desk.merged(1)
    desk.inference.poll()
    assert desk.policy.calls.count("infer") == 2
    assert list(desk.inference.metrics.delays) == [3]


def test_a_dropped_chunk_is_followed_by_a_new_query(desk: Desk) -> None:
    desk.inference.poll()
    desk.merged(1, dropped="too late")
    assert desk.inference.poll() is not None


def test_a_policy_that_is_there_again_is_told_what_the_lost_one_was() -> None:
    """A server that was started anew has heard of no reset."""
    desk = Desk().going()
    desk.policy.answer = PolicyLostError("gone")
    with pytest.raises(PolicyLostError):
        desk.inference.poll()
    desk.policy.answer = None
    desk.inference.poll()
    assert desk.policy.calls == ["reset", "infer", "reset", "infer"]


def test_nothing_is_asked_while_a_request_is_in_flight() -> None:
    desk = Desk(LockstepRunner(3)).going()
    answers = []
    for _ in range(4):
        answers.append(desk.inference.poll())
        desk.runner.tick()
    assert [answer is not None for answer in answers] == [False, False, False, True]
    assert desk.policy.calls == ["reset", "infer"]


def test_sync_asks_only_when_nothing_is_left_to_execute() -> None:
    desk = Desk(strategy=SYNC).going()
    desk.ticked(7, remaining=2)
    assert desk.inference.poll() is None
    desk.ticked(9, remaining=0)
    assert desk.inference.poll() is not None


def test_async_keeps_its_rate() -> None:
    desk = Desk(strategy=_async(inference_rate=5.0)).going()
    asked = []
    for step in range(30):
        desk.observe()
        desk.ticked(step)
        if desk.inference.poll() is not None:
            asked.append(step)
            desk.merged(len(asked))
        desk.clock.advance(1 / RATE)
    assert asked == [0, 6, 12, 18, 24]


def test_a_pause_drops_the_answer_that_is_still_in_flight() -> None:
    desk = Desk(LockstepRunner(2)).going()
    desk.inference.poll()
    desk.inference.pause()
    for _ in range(5):
        desk.runner.tick()
        assert desk.inference.poll() is None
    desk.inference.begin(2, fresh=False)
    assert desk.inference.poll() is None  # it asks anew, the old answer is gone
    assert desk.posted() == []
    assert desk.policy.calls == ["reset", "infer", "infer"]


def test_what_control_says_of_another_run_is_not_counted(desk: Desk) -> None:
    desk.merged(1, run=9)
    assert list(desk.inference.metrics.delays) == []


def test_the_policy_is_reset_once_per_run_and_before_its_first_inference(desk: Desk) -> None:
    for chunk in (1, 2, 3):
        desk.inference.poll()
        desk.merged(chunk)
    assert desk.policy.calls == ["reset", "infer", "infer", "infer"]
    desk.inference.pause()
    desk.inference.begin(1, fresh=False)  # resumed
    desk.inference.poll()
    desk.inference.pause()
    desk.inference.begin(2, fresh=True)
    desk.inference.poll()
    assert desk.policy.calls[4:] == ["infer", "reset", "infer"]


def test_the_policy_learns_once_that_the_robot_was_held(desk: Desk) -> None:
    told: list[int] = []
    desk.policy.resume = lambda: told.append(len(desk.policy.calls))  # type: ignore[method-assign]
    desk.inference.poll()
    desk.merged(1)
    desk.inference.pause()
    desk.inference.begin(1, fresh=False)
    for chunk in (2, 3):
        desk.inference.poll()
        desk.merged(chunk)
    desk.inference.pause()
    desk.inference.begin(2, fresh=True)
    desk.inference.poll()
    assert told == [2]
    assert desk.policy.calls == ["reset", "infer", "infer", "infer", "reset", "infer"]


def test_a_run_that_is_halted_before_it_asked_is_still_reset_when_it_resumes(desk: Desk) -> None:
    desk.inference.pause()
    desk.inference.begin(1, fresh=False)
    desk.inference.poll()
    assert desk.policy.calls == ["reset", "infer"]


@pytest.mark.parametrize(
    ("answer", "sentence"),
    [
        (PolicyError("the server is gone"), "the server is gone"),
        (ZeroDivisionError("oh"), "the policy's own code failed: ZeroDivisionError: oh"),
        (ActionChunk(np.full((4, 2), np.nan, np.float32)), "nan"),
    ],
)
def test_a_policy_that_fails_raises_once_and_posts_nothing(answer: Any, sentence: str) -> None:
    desk = Desk(LockstepRunner(1)).going()
    desk.policy.answer = answer
    desk.inference.poll()
    desk.runner.tick()
    with pytest.raises(PolicyError, match=sentence):
        desk.inference.poll()
    assert desk.posted() == []
    desk.policy.answer = None
    desk.inference.poll()  # not the old failure again: it asks anew
    desk.runner.tick()
    assert desk.inference.poll() is not None


def test_an_error_about_one_answer_is_told_as_the_policys_and_the_next_is_taken(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def note(answered: object) -> None:
        raise IndexError("index 3 is out of bounds")

    desk.going()
    with monkeypatch.context() as patch:
        patch.setattr(desk.requests, "log_ik_problems", note)
        with pytest.raises(PolicyError, match="cannot be used: IndexError: index 3 is out of bounds"):
            desk.inference.poll()
    assert "Traceback" in caplog.text
    assert desk.posted() == []
    assert desk.inference.poll() is not None
    assert len(desk.posted()) == 1


def test_a_policy_whose_answers_cannot_be_used_is_not_back(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk.going()
    monkeypatch.setattr(desk.requests, "log_ik_problems", lambda answered: [][0])
    for _ in range(100):
        desk.observe()
        with pytest.raises(PolicyError) as told:
            desk.inference.poll()
        if not desk.inference.should_retry(told.value):
            break
        desk.clock.advance(desk.inference.retry.due_in + 0.01)
    assert not desk.inference.should_retry(told.value)
    assert [note.kind for note in desk.inference.pending_notes] == ["policy_failed"]


def test_a_gap_in_the_observations_is_waited_out_and_an_error_where_it_lasts(desk: Desk) -> None:
    desk.clock.advance(0.5)
    assert desk.inference.poll() is None
    desk.observe()
    assert desk.inference.poll() is not None
    desk.merged(1)
    desk.clock.advance(0.5)
    assert desk.inference.poll() is None
    desk.clock.advance(1.1)
    with pytest.raises(PolicyError, match=r"1\.60 s old"):
        desk.inference.poll()


def test_a_slow_policy_in_its_thread_never_stops_the_caller() -> None:
    desk = Desk(ThreadRunner()).going()
    desk.policy.open.clear()
    assert desk.inference.poll() is None
    flight = desk.inference._flight
    assert flight is not None
    for _ in range(5):
        assert desk.inference.poll() is None
    desk.policy.open.set()
    flight.result(PATIENCE_S)
    assert desk.inference.poll() is not None
    assert desk.policy.calls == ["reset", "infer"]
    desk.runner.close()


def test_an_answer_that_the_former_policy_gives_late_is_never_used() -> None:
    desk = Desk(ThreadRunner()).going()
    former, other = desk.policy, FakePolicy()
    former.open.clear()
    desk.inference.poll()
    former.reached.wait(PATIENCE_S)
    desk.inference.set_policy(other, "place")
    connected = desk.runner.submit(other.connect)
    assert former.calls == ["reset", "infer", "close"]
    assert not desk.runner.ready(connected)  # never two: the last call of the former one is not over
    former.open.set()
    connected.result(PATIENCE_S)
    desk.inference.begin(2, fresh=True)
    assert desk.inference.poll() is None
    other.answered.wait(PATIENCE_S)
    answer = None
    while answer is None:
        answer = desk.inference.poll()
    assert (answer.run, len(desk.posted())) == (2, 1)
    assert former.calls == ["reset", "infer", "close"]
    assert other.calls == ["reset", "infer"]
    assert other.seen[0].prompt == "place"
    desk.runner.close()


def test_a_call_whose_turn_comes_after_the_exchange_is_still_the_former_policys(desk: Desk) -> None:
    calls: list[Any] = []

    def submit(call: Any) -> Future[Any]:
        calls.append(call)
        return Future()

    desk.runner.submit = submit  # type: ignore[method-assign]
    former, other = desk.policy, FakePolicy()
    desk.requests.send()
    desk.inference.set_policy(other, "place")
    calls[0]()
    assert former.calls == ["close", "reset", "infer"]
    assert other.calls == []


def test_the_same_policy_is_neither_closed_nor_told_to_forget_by_a_new_task(desk: Desk) -> None:
    desk.inference.poll()
    assert desk.inference.metrics.latencies
    desk.inference.set_policy(desk.policy, "place")
    assert desk.policy.calls == ["reset", "infer"]
    assert (len(desk.inference.metrics.latencies), len(desk.inference.metrics.delays)) == (0, 0)
    desk.requests.send()
    assert desk.policy.calls == ["reset", "infer", "infer"]
    assert desk.policy.seen[-1].prompt == "place"


def test_what_the_newest_merged_chunk_wants_for_a_step_is_known(desk: Desk) -> None:
    desk.policy.answer = ActionChunk(np.arange(8, dtype=np.float32).reshape(4, 2))
    desk.inference.poll()
    assert desk.inference.raw_action(10) is None  # posted, not merged
    targets = np.array([-1, 10, 11, 12])
    desk.inference.on_merged(MergeResult(1, 10, 1, targets, run=1))
    assert [desk.inference.raw_action(step) for step in (9, 13)] == [None, None]
    assert np.array_equal(desk.inference.raw_action(10), [2.0, 3.0])  # type: ignore[arg-type]
    assert np.array_equal(desk.inference.raw_action(12), [6.0, 7.0])  # type: ignore[arg-type]


def test_a_chunk_that_was_dropped_leaves_what_the_one_before_it_wants(desk: Desk) -> None:
    desk.inference.poll()
    desk.inference.on_merged(MergeResult(1, 10, 0, np.arange(10, 14), run=1))
    desk.inference.poll()
    desk.inference.on_merged(MergeResult(2, 12, 9, np.full(4, -1), dropped="all in the past", run=1))
    assert desk.inference.raw_action(10) is not None
    desk.inference.pause()
    assert desk.inference.raw_action(10) is None


RTC = Strategy(rtc.query(rtc.Config()), rtc.Config())


def _going(desk: Desk, mode: Mode) -> Desk:
    desk.inference.begin(1, True, mode)
    return desk


@pytest.mark.parametrize("mode", ["step", "preview"])
def test_a_mode_on_demand_asks_once_per_step_and_the_answer_waited(mode: Mode) -> None:
    desk = _going(Desk().going(), mode)
    assert desk.inference.poll() is None
    desk.inference.step()
    assert desk.inference.is_pending
    assert desk.inference.poll() is not None
    desk.inference.commit()
    (chunk,) = desk.posted()
    assert chunk.requested_while_stopped
    desk.merged(chunk.chunk_id)
    assert not desk.inference.is_pending
    assert desk.inference.poll() is None
    assert desk.policy.calls == ["reset", "infer"]


def test_a_strategy_that_waits_says_so_with_every_chunk() -> None:
    desk = Desk(strategy=SYNC).going()
    desk.inference.poll()
    assert [chunk.requested_while_stopped for chunk in desk.posted()] == [True]


def test_a_proposal_reaches_control_only_when_it_is_committed() -> None:
    desk = _going(Desk().going(), "preview")
    desk.inference.step()
    answer = desk.inference.poll()
    assert answer is not None
    assert desk.posted() == []
    shown, proposal = desk.inference.shown, desk.inference.proposal
    assert shown is not None
    assert proposal is not None
    assert (shown.number, shown.state, proposal.number) == (answer.chunk_id, "proposed", answer.chunk_id)
    desk.inference.commit()
    assert [chunk.chunk_id for chunk in desk.posted()] == [answer.chunk_id]
    assert desk.inference.proposal is None
    desk.inference.commit()  # there is nothing any more
    assert desk.posted() == []


def test_a_cancelled_proposal_is_gone_and_the_next_step_asks_anew() -> None:
    desk = _going(Desk().going(), "preview")
    desk.inference.step()
    desk.inference.poll()
    desk.inference.cancel()
    assert (desk.inference.proposal, desk.inference.shown, desk.inference.is_pending) == (None, None, False)
    desk.inference.commit()
    assert desk.posted() == []
    desk.inference.step()
    assert desk.inference.poll() is not None


def test_a_policy_that_is_lost_is_tried_again_with_back_off_until_patience_ends(desk: Desk) -> None:
    tries = []
    desk.policy.answer = PolicyLostError("no answer within 2 s")
    for tick in range(200):
        desk.observe()
        try:
            desk.inference.poll()
        except PolicyLostError as error:
            tries.append(tick / RATE)
            if not desk.inference.should_retry(error):
                break
        desk.clock.advance(1 / RATE)
    waits = np.diff(tries)
    assert (waits[1:] >= waits[:-1] - 1e-9).all()
    assert tries[-1] - tries[0] > 3.0
    assert len(tries) < 10
    assert [note.kind for note in desk.inference.pending_notes] == [
        "policy_lost"
    ]  # said once, not at every try


def test_a_policy_that_comes_back_is_welcome(desk: Desk) -> None:
    desk.policy.answer = PolicyLostError("gone")
    with pytest.raises(PolicyLostError) as lost:
        desk.inference.poll()
    assert desk.inference.should_retry(lost.value)
    assert desk.inference.retry.lost_for == 0.0
    assert desk.inference.retry.due_in > 0.0
    assert desk.inference.poll() is None  # not yet
    desk.policy.answer = None
    desk.clock.advance(0.15)
    desk.observe()
    assert desk.inference.poll() is not None
    assert [note.kind for note in desk.inference.pending_notes] == ["policy_lost", "policy_back"]
    assert desk.inference.retry.due_in == 0.0


def test_another_strategy_takes_over_while_a_request_is_in_flight() -> None:
    desk = Desk(LockstepRunner(2)).going()
    desk.inference.poll()
    desk.inference.tune(SYNC, "place")
    desk.runner.tick()
    desk.runner.tick()
    assert desk.inference.poll() is not None
    (chunk,) = desk.posted()
    assert not chunk.requested_while_stopped  # it was asked while the robot moved
    desk.merged(chunk.chunk_id)
    desk.ticked(9, remaining=3)
    assert desk.inference.poll() is None
    desk.ticked(12, remaining=0)
    desk.inference.poll()
    assert desk.policy.seen[-1].prompt == "place"


def test_rtc_tells_the_policy_what_control_has_merged_less_what_is_consumed() -> None:
    desk = Desk(strategy=RTC).going()
    desk.inference.poll()
    assert desk.policy.conditionings == [None]
    alone = np.zeros((0, 3))
    desk.inference.on_merged(MergeResult(1, 8, 1, np.array([-1, 8, 9, 10]), run=1, contributions=alone))
    desk.observe()
    desk.ticked(9)
    desk.inference.poll()
    given = desk.policy.conditionings[-1]
    assert given is not None
    assert (given.consumed_rows, given.predicted_delay) == (2, 1)
    assert given.previous.tolist() == [[7.0, 7.0]] * 4
    assert desk.inference.rtc["conditioned"]


def test_a_pause_forgets_what_the_robot_was_committed_to() -> None:
    desk = Desk(strategy=RTC).going()
    desk.inference.poll()
    desk.inference.on_merged(MergeResult(1, 8, 1, np.array([-1, 8, 9, 10]), run=1))
    desk.inference.pause()
    desk.inference.begin(1, fresh=False)
    desk.inference.poll()
    assert desk.policy.conditionings == [None, None]


def test_in_simulation_the_policy_is_shown_the_joints_of_the_simulated_robot(desk: Desk) -> None:
    desk.requests.policy_observation.use_simulated(True)
    status = desk.shared.control.read().copy()
    status["simulated"] = np.nan
    desk.shared.control.write(status)
    assert desk.requests.observe().qpos.tolist() == [
        0.0,
        0.0,
    ]  # it has not begun: it stands where the real one does
    status["simulated"] = [0.5, -0.5]
    desk.shared.control.write(status)
    shown = desk.requests.observe()
    assert shown.qpos.tolist() == [0.5, -0.5]
    assert shown.eef is None
    assert shown.step == 7


def test_figures_are_those_of_the_run(desk: Desk) -> None:
    desk.inference.poll()
    desk.merged(1, delay=3)
    desk.inference.poll()
    desk.merged(2, delay=5, dropped="too late")
    figures = desk.inference.metrics.figures()
    assert (figures["answers"], figures["dropped"]) == (2, 1)
    assert figures["delay_steps"]["max"] == 5.0
    assert desk.inference.metrics.recent()["delays"] == [3, 5]
    desk.inference.begin(2, fresh=True)
    assert desk.inference.metrics.figures()["delay_steps"] is None


# Where a chunk takes over


TOLD = np.array([0.25, -0.5], np.float32)
SEEN = np.array([0.2, -0.4], np.float32)


def onset_after(strategy: Strategy | None = None, behaviour: bytes = b"follow", **said: Any) -> ChunkStart:
    """Of the second request of a run, whose observation was of step 7, when control has done step 9."""
    desk = Desk(strategy=strategy).going()
    desk.inference.poll()
    desk.merged(1)
    desk.observe(qpos=SEEN)
    said = {"engaged": 1, "simulated": np.nan} | said
    desk.ticked(7, behaviour=behaviour, commanded=TOLD, **said)

    def slowly(observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        desk.ticked(9)
        return ActionChunk(np.zeros((4, 2), np.float32))

    desk.policy.infer = slowly  # type: ignore[method-assign]
    desk.inference.poll()
    found = desk.spaces.onsets[-1]
    assert found is not None
    return found


def test_a_chunk_is_anchored_where_control_is_when_its_answer_is_there() -> None:
    onset = onset_after()
    np.testing.assert_array_equal(onset.previous_command, TOLD)
    np.testing.assert_array_equal(onset.commanded, TOLD)
    assert onset.first_row == 3  # rows 0, 1, 2 are for steps 7, 8, 9, which have been sent


def test_no_more_rows_are_taken_for_stale_than_will_be_dropped() -> None:
    assert onset_after(_async(k_max=1)).first_row == 1


def test_a_chunk_that_the_robot_waited_for_starts_from_where_it_is_measured() -> None:
    onset = onset_after(SYNC)
    np.testing.assert_array_equal(onset.previous_command, SEEN)
    np.testing.assert_array_equal(onset.commanded, TOLD)
    assert onset.first_row == 0


def test_a_robot_that_was_never_told_anything_is_anchored_where_it_is_measured() -> None:
    onset = onset_after(engaged=0)
    np.testing.assert_array_equal(onset.previous_command, SEEN)
    np.testing.assert_array_equal(onset.commanded, SEEN)
    assert onset.first_row == 0


def test_in_simulation_a_chunk_goes_on_from_the_simulated_robot() -> None:
    onset = onset_after(behaviour=b"simulate", simulated=np.array([0.7, 0.8], np.float32))
    np.testing.assert_allclose(onset.previous_command, [0.7, 0.8], atol=1e-6)


def test_the_first_chunk_of_a_run_starts_from_where_the_robot_is_measured() -> None:
    desk = Desk().going()
    desk.observe(qpos=SEEN)
    desk.ticked(9, behaviour=b"hold", commanded=TOLD, simulated=np.nan, engaged=1)
    desk.inference.poll()
    onset = desk.spaces.onsets[-1]
    assert onset is not None
    np.testing.assert_array_equal(onset.previous_command, SEEN)
    assert onset.first_row == 1


# Poses that were measured, and how poses were met


@pytest.mark.parametrize(("wanted", "shown"), [("measured", 0.5), ("fk", 0.0)])
def test_a_policy_is_shown_measured_poses_or_those_of_the_joints(
    wanted: Any, shown: float, desk: Desk
) -> None:
    desk.policy.observation_eef, desk.policy.uses_poses = wanted, True
    desk.observe(eef=np.full(8, 0.5, np.float32), captured={"joints": 100.0, "cam": 100.0, "eef": 100.0})
    answer = desk.inference.poll()
    assert desk.policy.seen[-1].eef is not None
    assert desk.policy.seen[-1].eef.tolist() == [shown] * 8
    assert answer is not None
    assert answer.eef == wanted


def test_where_nothing_is_measured_the_poses_are_those_of_the_joints(desk: Desk) -> None:
    desk.policy.uses_poses = True
    answer = desk.inference.poll()
    assert answer is not None
    assert answer.eef == "fk"


def solved_with(flags: Any, metres: Any) -> IkResult:
    flags = np.array(flags, np.uint8)
    return IkResult(np.zeros((4, 2)), np.array(metres), np.zeros(flags.shape), flags)


def test_how_poses_were_met_is_recorded_told_and_counted(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    solved = solved_with([[0, 0], [1, 4], [3, 0], [8, 8]], [[0, 0], [0.012, 0], [0.002, 0], [0, 0]])
    rows = CommandRows(np.zeros((4, 2)), np.arange(4), solved, np.array([0.1, 0.2]))
    monkeypatch.setattr(desk.spaces, "to_command", lambda chunk, observation, onset: rows)
    answer = desk.inference.poll()
    assert answer is not None
    np.testing.assert_array_equal(answer.ik_flags, solved.flags)
    np.testing.assert_array_equal(answer.position_error, solved.position_error)
    (note,) = desk.inference.pending_notes
    assert note.kind == "ik_unreached"
    assert "2 of 4 poses are not reached, the worst by 12.0 mm" in note.text
    figures = {
        "rows": 4,
        "over": 2,
        "limit": 1,
        "velocity": 1,
        "singular": 1,
        "worst_mm": 12.0,
        "worst_deg": 0.0,
    }
    assert note.data == pytest.approx(figures)
    assert desk.inference.metrics.recent()["ik"] == note.data
    (posted,) = desk.posted()
    assert posted.intended_start is not None
    np.testing.assert_array_equal(posted.intended_start, [0.1, 0.2])
    desk.merged(1)
    assert desk.inference.shown is not None
    assert desk.inference.shown.ik == note.data
    desk.inference.poll()
    assert desk.inference.metrics.figures()["ik"]["over"] == 4


def test_poses_that_are_all_reached_are_no_event(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = CommandRows(np.zeros((4, 2)), np.arange(4), solved_with([[4, 2]] * 4, [[0.0, 0.0]] * 4))
    monkeypatch.setattr(desk.spaces, "to_command", lambda chunk, observation, onset: rows)
    desk.inference.poll()
    assert desk.inference.pending_notes == []
    assert desk.inference.metrics.recent()["ik"]["velocity"] == 4
