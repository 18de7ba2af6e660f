"""Robot with faulty encoders: its commands must stay within limits, and never jump away from the robot."""

from __future__ import annotations

import numpy as np

from benchmarks.fuzzing.bodies import drawn
from benchmarks.fuzzing.faults import FAULTS, KEPT
from runtime.core.types import Float64
from runtime.ipc.shared_state import EStop
from runtime.motion.timeline import difference
from runtime.spaces.binary_grippers import MIN_SWITCH_INTERVAL_S
from tests.runtime.tick_bench import PERIOD, Bench

_TICKS = 240
_NOISE = 2e-5  # [rad] of an intact encoder
_NEAR = (
    0.35  # [rad] distance from the robot to which a command may step: how far it moves while samples agree
)
_MARGIN = 1.05
_SOUND = 12  # ticks
_RESTS = round(MIN_SWITCH_INTERVAL_S / PERIOD)  # ticks between two switches of a gripper
_TURN = 2.0 * np.pi
_JITTER = 0.05  # [rad] of a noisy encoder


class Scenario(Bench):
    """Robot that follows its commands with a delay, observed by encoders that sometimes fail.

    Joints without limits are read within one turn, or over several. In node-driven mode the robot moves by itself.
    """

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.name, limits, dims, switches, ready = drawn(self.rng)
        self.body = ready.copy()
        self.places, self.speeds = limits.position_mask, list(limits.speeds)
        self.ends = {switch.dim: (switch.open, switch.close) for switch in switches}
        self.wraps = list(dims.wrapping) if self.rng.random() < 0.7 else []
        self.fault, self.since, self.kept = "", 0, self.body
        kind = str(self.rng.choice(["async", "naive", "ensemble"]))
        super().__init__({"kind": kind}, limits, dims, switches=switches)
        for dim in self.ends:  # it may hold an object
            self.body[dim] = self.rng.uniform(limits.lower[dim], limits.upper[dim])
        self.measured = self.body
        self.wish = self.body  # target of a hand, or of the node's own leader, that moves the robot
        self.pushed = False
        self.sound = 0  # ticks without a fault
        self.run_number = self.chunks = 0
        self.previous: Float64 | None = None
        self.velocity = np.zeros((2, self.dim))  # bounds of the last command's velocity
        self.switched = dict.fromkeys(self.ends, -_RESTS)  # tick of each gripper's last switch
        self.violations: list[str] = []

    def _stand(self) -> None:
        """Let the robot hold until the monitor has learnt that its encoders are never still."""
        for _ in range(3 * _SOUND):
            self.observe(qpos=self.read().astype(np.float32))
            self.tick(self.step, self.clock.now())
            self.clock.advance(PERIOD)

    # --- events -------------------------------------------------------------------------------------------------

    def act(self) -> None:
        """Cause a random event in some ticks."""
        if self.rng.random() < 0.06:
            kinds = ["follow", "follow", "motion", "hold", "estop", "push", "sim", "yield", "lock"]
            stopped = self.shared.estop is EStop.LATCHED and self.rng.random() < 0.5
            getattr(self, "_clear" if stopped else f"_{self.rng.choice(kinds)}")()
        self.sound = 0 if self.fault else self.sound + 1
        # The first samples, and those after a gap, cannot be distinguished from intact ones by their values.
        if self.sound > _SOUND and self.rng.random() < 0.05:
            faults = [*FAULTS, *KEPT]
            if self.pushed:  # at full speed, swapped values no longer match each other
                faults.remove("swapped")
            self.fault, self.since = str(self.rng.choice(faults)), 0
            free = np.where(self.places & (self.rng.random(self.dim) < 0.5), self._somewhere(1.0), self.body)
            self.kept = self.body.copy() if self.fault == "frozen" else free
        elif self.fault and self.rng.random() < 0.1:
            self.fault = ""
        if self.run_number and self.rng.random() < 0.3:
            self._chunk()

    def _somewhere(self, reach: float) -> Float64:
        near = self.body + self.rng.uniform(-reach, reach, self.dim)
        return np.asarray(
            np.where(self.places, np.clip(near, self.limits.lower, self.limits.upper), self.body)
        )

    def _anything(self, reach: float) -> Float64:
        """Return random joints within `reach`, with grippers and speeds at any value within their limits."""
        place, free = self._somewhere(reach), ~self.places
        place[free] = self.rng.uniform(self.limits.lower[free], self.limits.upper[free])
        return place

    def _follow(self) -> None:
        self.run_number += 1
        self.say("follow", run=self.run_number)

    def _motion(self) -> None:
        goal = self._anything(0.6)
        self.say("motion", goal=np.where(self.rng.random(self.dim) < 0.2, np.nan, goal), speed=1.0)

    def _hold(self) -> None:
        self.say("hold", run=self.run_number)

    def _sim(self) -> None:
        self.run_number += 1
        self.say("follow", run=self.run_number, mode="sim")

    def _yield(self) -> None:
        self.run_number += 1
        self.say("yield", run=self.run_number)

    def _lock(self) -> None:
        locked = self.limits.grippers & (self.rng.random(self.dim) < 0.5)
        self.lock(*np.where(locked, self._anything(0.0), np.nan))

    def _estop(self) -> None:
        self.shared.set_estop(EStop.LATCHED)

    def _clear(self) -> None:
        self.shared.set_estop(EStop.CLEAR)

    def _push(self) -> None:
        self.pushed, self.wish = bool(self.rng.random() < 0.5), self._somewhere(1.2)

    def _chunk(self) -> None:
        self.chunks += 1
        start = np.array(self.status["commanded"], np.float64)
        rows = np.linspace(start, start + self._apart(self._anything(0.3), start), 30)
        jumps = np.flatnonzero(self.limits.grippers)
        rows[:, jumps] = self._anything(0.0)[jumps]
        self.chunk(self.chunks, rows, run=self.run_number)

    # --- one tick ------------------------------------------------------------------------------------------------

    def read(self) -> Float64:
        """Return the readings of the encoders."""
        sound = self._turned(self.body + self.rng.normal(0.0, _NOISE, self.dim) * self.places)
        return self._faulty(sound) if self.fault else sound

    def _turned(self, joints: Float64) -> Float64:
        read = joints.copy()
        read[self.wraps] = (read[self.wraps] + np.pi) % _TURN - np.pi
        return read

    def _faulty(self, sound: Float64) -> Float64:
        self.since += 1
        if self.fault == "stuck":
            return np.where(self.kept != self.body, self._turned(self.kept), sound)
        frozen = self.fault in KEPT
        faulty = self._turned(self.kept) if frozen else FAULTS[self.fault](self.rng, sound, self.since - 1)
        return np.where(self.places, faulty, sound)

    def run_tick(self) -> None:
        """Run one tick: observe the robot, command it, and move it."""
        self._begun = True
        for process in ("coordinator", "guard"):
            self.shared.beat(process, self.clock.now())
        self.act()
        self.observe(qpos=self.read().astype(np.float32))
        before = len(self.sink.sent)
        self.tick(self.step, self.clock.now())
        self.check(self.sink.sent[before:])
        self.step += 1
        self.clock.advance(PERIOD)
        self._move()

    def _move(self) -> None:
        """Move the robot for one tick, by its command, by hand, or by its own node."""
        led = self.behaviour == "yield"
        if led and self.rng.random() < 0.05:
            self.wish = self._somewhere(0.5)
        goal = self.wish if self.pushed or led else self.previous
        if goal is None:
            self.body[self.speeds] = 0.0
            return
        most = self.limits.velocity * PERIOD
        follow = self.body + np.clip(0.6 * self._apart(goal, self.body), -most, most)
        self.body = np.where(self.places | self.pushed, follow, goal)

    # --- violations ----------------------------------------------------------------------------------------------

    def _apart(self, target: Float64, origin: Float64) -> Float64:
        return difference(target, origin, self.dims.wrapping)

    @property
    def _known(self) -> Float64:
        """Joints as far as the runtime can know them: motion during a frozen encoder is invisible."""
        return self.kept if self.fault == "frozen" else self.body

    def check(self, sent: list[Float64]) -> None:
        """Record the violations in the commands of this tick."""
        record = self.records()[-1]
        if len(sent) > 1 or (sent and self.behaviour == "yield"):
            self._wrong("told twice in one tick, or beside the node that leads")
        if not sent:
            self.previous, self.velocity = None, np.zeros((2, self.dim))
            return
        action, stopped = sent[0].astype(np.float64), record.source == "estop"
        if (
            not np.isfinite(action).all()
            or (self.limits.excess(action) > 1e-5 * self.limits.radian_scale).any()
        ):
            self._wrong(f"beyond the limits or no number: {action.tolist()}")
        if stopped and action[self.speeds].any():
            self._wrong(f"drives under the e-stop: {action[self.speeds].tolist()}")
        if self.previous is not None:
            self._compare(action, self.previous, " ".join(record.notes), stopped)
        elif (np.abs(self._apart(action, self._known)) > _NEAR)[self.places].any():
            self._wrong("taken over where it is not")
        self._check_grippers(action, stopped)
        self.previous = action

    def _check_grippers(self, action: Float64, stopped: bool) -> None:
        """Check that grippers are commanded open or closed, and do not switch too often.

        `action` [D] is the command of this tick. A gripper may be commanded to a position in between in two cases: if
        the command for this gripper does not change, or if this is the first command of the scenario and the e-stop is
        pressed (`stopped`).
        """
        for dim, ends in self.ends.items():
            before = None if self.previous is None else self.previous[dim]
            switches = not np.isclose(action[dim], action[dim] if before is None else before)
            if not np.isclose(action[dim], ends).any() and (switches or not (stopped or before is not None)):
                self._wrong(f"a gripper neither open nor closed: {action[dim]}")
            if switches and before is not None and np.isclose(before, ends).any():
                if self.step - self.switched[dim] < _RESTS:
                    self._wrong("a gripper switches too often")
                self.switched[dim] = self.step

    def _compare(self, action: Float64, before: Float64, notes: str, stopped: bool) -> None:
        moved = (action - before) / PERIOD
        if "where the robot is" in notes:
            hardest = 60.0 * self.limits.radian_scale * _MARGIN * PERIOD
            onwards = np.clip(moved, -hardest, hardest)  # it counts as at rest, or has continued from there
            self.velocity = np.array([np.minimum(onwards, 0.0), np.maximum(onwards, 0.0)])
            apart = np.abs(action - before) > 1e-6
            near = np.maximum(np.abs(self._apart(before, self._known)), _NEAR)
            if (apart & (np.abs(self._apart(action, self._known)) > near))[self.places].any():
                self._wrong(f"stepped away from the robot: {notes}")
            if (np.abs(action - before) > np.pi)[list(self.dims.wrapping)].any():
                self._wrong(f"stepped by a turn: {notes}")
            return
        free = ~self.limits.binary
        if stopped:
            free[self.speeds] = False
        if (np.abs(moved) > self.limits.velocity * _MARGIN + 1e-3 * self.limits.radian_scale)[free].any():
            self._wrong(f"faster than it moves: {moved.tolist()} {notes}")
        least, most = self.velocity
        if stopped:
            least, most = np.minimum(least, 0.0), np.maximum(most, 0.0)
            free = free & self.places
        gain = 60.0 * self.limits.radian_scale * _MARGIN * PERIOD + 1e-2 * self.limits.radian_scale
        edge = (action <= self.limits.lower + 1e-6) | (action >= self.limits.upper - 1e-6)
        if ((moved > most + gain) | (moved < least - gain))[free & ~edge].any():
            self._wrong(f"harder than it accelerates: {notes}")
        self.velocity = np.array([moved, moved])

    def _wrong(self, problem: str) -> None:
        doing = f"{self.name}, tick {self.step}, {self.behaviour}, encoders {self.fault or 'sound'}"
        self.violations.append(f"{doing}: {problem}")


class EncoderOffsetScenario(Bench):
    """Robot at rest with one faulty joint encoder: it must not run away, and no run may begin meanwhile."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.name, limits, dims, _, ready = drawn(rng)
        self.body = ready.copy()
        super().__init__({"kind": "naive"}, limits, dims)
        self.measured = self.body
        self._joint = int(rng.choice(np.flatnonzero(limits.position_mask)))
        self._offset, self._scale = rng.uniform(-1.5, 1.5), float(rng.choice([-1.0, 1.0, 1.0, 1.2]))
        self._within = float(rng.choice([PERIOD, 0.5, 2.0]))  # [s] time in which the offset grows
        self._comes_and_goes = bool(rng.random() < 0.5)  # never long enough to be trusted again
        self._lag = float(
            rng.choice([1.0, 0.3])
        )  # share of the distance to its command that it moves per tick
        self._stopped = bool(rng.random() < 0.5)
        self._fault = str(rng.choice(["off", "off", "no number", "noise", "drift"]))
        if self._fault == "drift":
            self._within, self._comes_and_goes = float(rng.uniform(3.0, 7.0)), False
        self._rng = rng

    def violations(self) -> list[str]:
        """Run the scenario, and return as sentences how the commands of the robot violate the rules."""
        self.say("motion", goal=self.body)
        self.run(10)
        if self._stopped:
            self.shared.set_estop(EStop.LATCHED)
            self.run(20)
        begins, problems = self.sent[-1], set[str]()
        first_sent = len(self.sent)
        for tick in range(_TICKS):
            self.moved_by_hand = self.measured = self._read(tick * PERIOD)
            self.run()
            problems.update(self._wrong(self.measured))
            self.body += self._lag * (self.sent[-1] - self.body)
        places = self.limits.position_mask
        steps = np.abs(np.diff(self.sent[first_sent - 1 :], axis=0))[:, places]
        far = np.ptp(self.sent[first_sent - 1 :], axis=0)[places].max()
        if (steps > self.limits.velocity[places] * PERIOD * _MARGIN + 1e-4).any():
            problems.add("stepped faster than it moves")
        if far > self._bound(begins):
            problems.add(f"ran away by {far:.2f} rad")
        joint = self.limits.names[self._joint]
        return [f"{self.name}, encoder of {joint}: {self._fault}: {problem}" for problem in sorted(problems)]

    def _read(self, since: float) -> Float64:
        """Return the readings of the encoders [D] at `since` [s] after the fault began."""
        read = self.body.copy()
        if self._fault == "no number":
            read[self._joint] = np.nan
        elif self._fault == "noise":
            read[self._joint] += self._rng.normal(0.0, _JITTER)
        else:
            gone = self._comes_and_goes and since % 0.8 >= 0.4
            grown = 0.0 if gone else min(since / self._within, 1.0)
            read[self._joint] = (1.0 + grown * (self._scale - 1.0)) * read[self._joint] + grown * self._offset
        return read

    def _wrong(self, read: Float64) -> set[str]:
        """Return the violations in the tick in which the encoders' readings were `read` [D]."""
        problems, action, places = set[str](), self.sent[-1], self.limits.position_mask
        if (
            not np.isfinite(action).all()
            or (self.limits.excess(action) > 1e-5 * self.limits.radian_scale).any()
        ):
            problems.add("told beyond the limits, or no number")
        if self._stopped and self.behaviour != "estop":
            problems.add(f"does not stand under the e-stop: {self.behaviour}")
        near = np.abs(difference(read, action, self.dims.wrapping)) <= self.safety.following_error + 1e-4
        if not self.shared.joint_problem and not near[places].all():
            problems.add("a run may begin although the joint is not where it is held")
        return problems

    def _bound(self, begins: Float64) -> float:
        """Return the largest displacement [rad] that control may accept without distrusting the joints.

        It is the following error plus the offset of the faulty encoder. `begins` [D] are the joints at which the fault
        begins, which matter if the encoder also scales.
        """
        scaled = abs((self._scale - 1.0) * begins[self._joint])
        return float(self.safety.following_error + abs(self._offset) + scaled + 0.1)


def once(seed: int) -> list[str]:
    """Return the violations in the scenario of `seed`, as sentences."""
    scenario = Scenario(seed)
    for _ in range(_TICKS):
        scenario.run_tick()
    violations = [*scenario.violations, *EncoderOffsetScenario(seed).violations()]
    return [f"seed {seed}: {violation}" for violation in violations]
