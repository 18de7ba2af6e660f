"""Whatever is asked of a station, and whatever fails, in whatever order: it moves only when somebody asked."""

from __future__ import annotations

import tempfile
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from runtime.core.errors import PolicyError, PolicyLostError
from runtime.core.types import Float64
from runtime.ipc.messages import ExecutedTick, MergeResult, decode
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import EStop
from runtime.processes.control.process import make_tick
from runtime.processes.coordinator.session.transitions import COMMANDS
from tests.examples import some
from tests.runtime.lockstep_station import DIM, STANDS, Station, stubbed

PERIOD = 1 / 30
BRAKES = 10.0  # [rad/s2] at least, half of what a stop is set to: the last step of one is shorter
RESTS = 15  # ticks for which an e-stop goes along with an arm that comes to rest
AGREED = 60  # ticks that samples of an arm which was moved again and again have to agree for
FAR = 0.55  # [rad] that a robot which stands may be from its command: the following error, and what it is still on
MODES = ("continuous", "step", "preview", "sim", "manual")
STRATEGIES = ("sync", "async", "naive", "ensemble", "rtc")
SET_GOING = ("commit", "approach", "step", "move", "gripper")  # by a person, within a run or beside it
joint = st.integers(0, DIM - 1)
ticks = st.integers(1, 12)
deeds = st.one_of(  # of a person within a run
    st.tuples(st.sampled_from(["step", "step", "commit", "cancel", "approach"]), st.just({})),
    st.tuples(
        st.just("gripper"),
        st.fixed_dictionaries({"action": st.sampled_from(["open", "close", "lock", "unlock"])}),
    ),
    st.tuples(
        st.just("tune"),
        st.fixed_dictionaries(
            {
                "strategy": st.fixed_dictionaries(
                    {
                        "kind": st.sampled_from(STRATEGIES),
                        "execution_horizon": st.sampled_from([None, 1, 7]),
                        "inference_rate": st.sampled_from([None, 3.0]),
                        "k_max": st.sampled_from([None, 0, 2]),
                    }
                )
            }
        ),
    ),
    st.builds(
        lambda index, away, speed: ("move", {"joints": _aside(index, away).tolist(), "speed": speed}),
        joint,
        st.floats(-1.0, 1.0),
        st.floats(0.1, 1.0),
    ),
)
commands = st.one_of(
    st.tuples(st.sampled_from(["halt", "resume", "stop", "home", "setup", "approach"]), st.just({})),
    st.tuples(st.just("run"), st.fixed_dictionaries({"mode": st.sampled_from(MODES)})),
    st.tuples(st.just("run"), st.just({"trial": {"id": 1}})),
)
behaviours = st.sampled_from(["ramp", "wild", "nan", "error", "lost", "far", "short"])


def _aside(index: int, away: float) -> Float64:
    goal = STANDS.copy()
    goal[index] += away if index not in (6, 13) else 0.0
    return goal


class Machine(RuleBasedStateMachine):
    """A lockstep station, the hands of several people, and a witness that looks at it after every tick."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.does = "ramp"
        self.keeps_lease = True
        self.still = 0  # ticks for which nobody has asked for a motion
        self.going = False  # a person has set something going
        self.moved = 0  # ticks since the arm was moved by hand
        self.seen: deque[Float64] = deque(maxlen=3)  # what was measured last
        self.merged: set[tuple[str, int]] = set()

    @initialize(delay=st.integers(0, 4), home=st.booleans(), strategy=st.sampled_from(STRATEGIES))
    def begin(self, delay: int, home: bool, strategy: str) -> None:
        self.watch(
            Station(
                stubbed(
                    Path(self.folder.name),
                    self.rows,
                    strategy=strategy,
                    delay=delay,
                    setup={"home": home},
                    recording={"enabled": False},
                    faults={"policy_error": "slow"},
                )
            )
        )

    def watch(self, station: Station) -> None:
        """Be the witness of that station."""
        self.station = station
        self.limits = station.spec.limits
        self.records: list[Any] = []
        ring = station.shared.rings["ticks"]
        push = ring.push
        ring.push = lambda payload: self.records.append(decode(payload)) or push(payload)  # type: ignore[method-assign]
        self.speed: Float64 = np.zeros(DIM)
        self.tick(3)

    def rows(self, observation: Any, number: int) -> Any:
        """What the policy answers just now."""
        if self.does in ("error", "lost"):
            raise (PolicyError if self.does == "error" else PolicyLostError)(self.does)
        here = np.asarray(observation.qpos, np.float64)
        if self.does == "far":
            here = here + 0.4
        chunk = here + np.outer(np.arange(1, 3 if self.does == "short" else 16), 0.01 * np.ones(DIM))
        if self.does == "wild":
            chunk += np.random.default_rng(number).normal(0.0, 0.3, chunk.shape)
        if self.does == "nan":
            chunk[2:, 3] = np.nan
        return chunk

    # --- what happens --------------------------------------------------------------------------------------

    @rule(given=deeds, wait=st.integers(1, 40))
    def deed(self, given: tuple[str, dict[str, Any]], wait: int) -> None:
        self.command(given, wait)

    @rule(given=commands, wait=ticks)
    def command(self, given: tuple[str, dict[str, Any]], wait: int) -> None:
        kind, arguments = given
        session = self.station.coordinator.session
        allowed, before = session.allowed(), session.state
        if self.keeps_lease:
            self.station._handle("lease_claim")
        ack = self.station._handle(kind, arguments)
        if kind not in allowed or not self.keeps_lease:
            assert ack.status == "refused", (kind, before)
        if ack.status == "accepted":
            after = COMMANDS[kind].next(before) or before
            cancelled = before is SessionState.SETTING_UP
            assert session.state is (SessionState.IDLE if cancelled else after)
            self.going = kind in SET_GOING or (self.going and kind == "tune")
        else:
            assert ack.reason
            assert session.state is before
        self.tick(wait)

    @rule(arguments=st.dictionaries(st.text(max_size=5), st.integers() | st.text(max_size=3), max_size=2))
    def nonsense(self, arguments: dict[str, Any]) -> None:
        for kind in ("setup", "run", "tune", "move", "gripper", "aim"):
            ack = self.station._handle(kind, {"x": 1} | arguments)
            assert ack.status == "refused"

    @rule(wait=st.integers(1, 60))
    def time_passes(self, wait: int) -> None:
        self.tick(wait)

    @rule(mode=st.sampled_from(MODES), wait=ticks)
    def work(self, mode: str, wait: int) -> None:
        """Whatever is in the way of a run is cleared away, so that not every example ends where nothing moves."""
        robot = self.station.robot
        robot.blocked = robot.silent = False
        self.does, self.keeps_lease = "ramp", True
        if self.station.state is SessionState.FAULTED:
            self.release(3)
        for kind, arguments in (("stop", {}), ("setup", {}), ("run", {"mode": mode})):
            self.tick(3)
            if kind in self.station.coordinator.session.allowed():
                self.command((kind, arguments), 1)
            for _ in range(200):
                if self.station.state is SessionState.SETTING_UP:
                    self.tick(1)
        self.tick(wait)

    @rule(does=behaviours)
    def policy_changes(self, does: str) -> None:
        self.does = does

    @rule(
        kind=st.sampled_from(["e-stop", "release", "lease", "control", "coordinator", "blocked", "silent"]),
        wait=st.integers(1, 40),
    )
    def trouble(self, kind: str, wait: int) -> None:
        robot, main = self.station.robot, self.station.coordinator
        if kind == "e-stop":
            self.station.guard.press("anna", "a test")
            self.going = False
        elif kind == "release" and self.station.state is SessionState.FAULTED:
            self.release(1)
        elif kind == "lease":
            self.keeps_lease = not self.keeps_lease
            main.lease.release("lockstep", main.lease.epoch, self.station.clock.now())
            self.going = False
        elif kind == "control":
            self.restart_control()
        elif kind == "coordinator":
            self.restart_main()
        elif kind == "blocked":
            robot.blocked = not robot.blocked
        elif kind == "silent":
            robot.silent = not robot.silent
        self.tick(wait)

    @rule(index=joint, away=st.floats(-1.5, 1.5), wait=ticks)
    def moved_by_hand(self, index: int, away: float, wait: int) -> None:
        if index not in (6, 13):
            self.station.robot.position[index] += away
            self.moved = 0
        self.tick(wait)

    def release(self, wait: int) -> None:
        self.keeps_lease, self.going = True, False
        self.station._handle("lease_claim")
        self.station._handle("release")
        self.tick(wait)

    def restart_control(self) -> None:
        station = self.station
        for _ in station.shared.rings["orders"].drain():
            pass
        station._tick = make_tick(station.spec, station.shared, station._sink, station.clock.now)
        station.shared.set_generation("control", station.shared.generation("control") + 1)
        self.going, self.speed = False, np.zeros(DIM)

    def restart_main(self) -> None:
        station = self.station
        station.shared.beat("coordinator", 0.0)
        station.shared.set_generation("coordinator", station.shared.generation("coordinator") + 1)
        told = len(station.robot.commands)
        station._tick(station.step, station.clock.now())  # control sees that nobody is there
        self.look(station.shared.observation.read()["qpos"].astype(np.float64), told)
        station.step += 1
        station.clock.sleep_until(station.step / station.spec.rate)
        station.restart_coordinator()
        self.going = False
        self.merged.clear()

    # --- the witness ---------------------------------------------------------------------------------------

    def tick(self, count: int) -> None:
        station = self.station
        for _ in range(count):
            if self.keeps_lease:
                held = station.coordinator.lease.current(station.clock.now())
                station._handle("lease_renew" if held else "lease_claim")
            told = len(station.robot.commands)
            station.tick()
            self.look(station.shared.observation.read()["qpos"].astype(np.float64), told)

    def look(self, measured: Float64, told: int) -> None:
        station = self.station
        status = station.shared.control.read()
        new = station.robot.commands[told:]
        assert len(new) == int(status["engaged"])
        stepped = any(
            "stepped" in note for r in self.records if isinstance(r, ExecutedTick) for note in r.notes
        )
        self.weigh()
        self.seen.append(measured)
        self.moved += 1
        station.coordinator.snapshot()
        asked = self.asked()
        self.going = self.going and self.busy(status)
        self.still = 0 if asked else self.still + 1
        if not new:
            return
        sent = new[-1].action.astype(np.float64)
        before = station.robot.commands[told - 1].action.astype(np.float64) if told else measured
        arms = ~self.limits.grippers
        if stepped:  # it is held where it is found, and the record says so
            seen = np.clip(
                self.seen, self.limits.lower, self.limits.upper
            )  # it goes by the middle one of three
            found = np.clip(sent, seen.min(axis=0), seen.max(axis=0))
            nearer = np.abs(sent - found) <= np.abs(before - found) + 1e-6
            assert nearer[arms].all()
            self.speed = np.zeros(DIM)
            return
        speed = self.speed
        self.limit(sent, before)
        along = (
            station.shared.estop is EStop.LATCHED and self.moved <= RESTS
        )  # with an arm that was pushed meanwhile
        if self.still > 1 and not along:  # it comes to a stand, and stays there
            less = np.maximum(np.abs(speed) - BRAKES * self.limits.radian_scale * PERIOD, 0.0)
            slower = np.abs(self.speed) <= less + 1e-3
            assert slower[arms].all(), (
                station.state,
                station.reason,
            )  # a locked gripper goes on to its place
        fresh = station.clock.now() - float(station.shared.observation.read()["joints_captured"]) < 0.1
        if (
            min(self.still, self.moved - AGREED) > 12
            and fresh
            and status["believed"]
            and station.state is not SessionState.FAULTED
        ):
            assert np.abs(sent - measured)[arms].max() <= FAR, (station.state, station.reason)

    def limit(self, sent: Float64, before: Float64) -> None:
        limits = self.limits
        assert (sent >= np.minimum(limits.lower, before) - 1e-5).all()
        assert (sent <= np.maximum(limits.upper, before) + 1e-5).all()
        speed = (sent - before) / PERIOD
        assert (np.abs(speed) <= limits.velocity * 1.001 + 1e-4).all()
        if self.station.shared.estop is EStop.CLEAR:
            rate = 60.0 * limits.radian_scale * PERIOD
            assert (np.abs(speed - self.speed) <= rate * 1.06 + 1e-3).all()
        self.speed = speed

    def asked(self) -> bool:
        """Whether somebody wants the real robot to move just now."""
        main = self.station.coordinator
        run, state = main.run, main.session.state
        if state is SessionState.SETTING_UP:
            return True
        if state is SessionState.RUNNING and run is not None and run.mode == "continuous":
            return True
        return self.going and state in (SessionState.READY, SessionState.RUNNING, SessionState.HOLDING)

    def busy(self, status: Any) -> bool:
        """Whether what a person has set going is still under way."""
        main = self.station.coordinator
        if main.run is not None and main.run.mode == "sim":
            return False  # whatever is asked for in it
        ways = np.abs(status["locked"] - status["commanded"]) > 1e-6  # to where a gripper is locked
        moves = bytes(status["behaviour"]) == b"motion" or bool(status["remaining"])
        return moves or main.inference.is_pending or bool(ways.any())

    def weigh(self) -> None:
        for record in self.records:
            if isinstance(record, ExecutedTick) and record.chunk_ids:
                assert sum(record.weights) == pytest.approx(1.0)
                assert min(record.weights) > 0
            if isinstance(record, MergeResult) and not record.dropped:
                assert (record.strategy, record.chunk_id) not in self.merged  # executed once
                self.merged.add((record.strategy, record.chunk_id))
                assert record.targets.max() >= record.arrival_step
        self.records.clear()

    def teardown(self) -> None:
        if hasattr(self, "station"):
            self.station.close()
        self.folder.cleanup()


TestStation = Machine.TestCase
TestStation.settings = settings(
    max_examples=some(30),
    stateful_step_count=30,
    suppress_health_check=list(HealthCheck),
)
