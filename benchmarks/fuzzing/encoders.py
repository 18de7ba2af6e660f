"""A robot with faulty encoders, whatever it does: what it is told stays within limits, and never jumps away from it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

import robots
from runtime.family import Plan
from runtime.limits import Limits
from runtime.page import EStop
from runtime.timeline import Dims
from runtime.types import Float64
from tests.runtime.tick_bench import PERIOD, Bench

_TICKS = 240
_NOISE = 2e-5  # [rad] of a sound encoder
_NEAR = 0.35  # [rad] from the robot that a command may step to: how far it goes while samples agree
_MARGIN = 1.05
_SOUND = 12  # ticks

Fault = Callable[[np.random.Generator, Float64, int], Float64]


def _zeros(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    return np.zeros_like(joints)


def _dead(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    return np.where(rng.permutation(len(joints)) < 2, 0.0, joints)


def _spike(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    return joints if since else joints + rng.uniform(-1.5, 1.5, len(joints))


def _beyond(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    return joints + np.where(rng.permutation(len(joints)) == 0, 9.0, 0.0)


def _noise(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    return joints + rng.normal(0.0, 1.0, len(joints))


def _swapped(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    swapped = joints.copy()
    swapped[[0, 1, 2]] = joints[[2, 0, 1]]
    return swapped


def _missing(rng: np.random.Generator, joints: Float64, since: int) -> Float64:
    return np.full_like(joints, np.nan)


_FAULTS: dict[str, Fault] = {
    "zeros": _zeros,
    "dead": _dead,
    "spike": _spike,
    "beyond": _beyond,
    "noise": _noise,
    "swapped": _swapped,
    "missing": _missing,
}
# They keep what they read when they begin, or a number of their own.
_KEPT = ("frozen", "stuck")


@cache
def limits_of(name: str) -> tuple[Limits, Dims, Float64]:
    """What the robot `name` can do, which of its numbers do not blend, and where it is ready [D]."""
    robot = robots.load(name)
    plan = Plan.__new__(Plan)
    object.__setattr__(plan, "robot", robot)
    return plan.limits, plan.dims, robot.poses["ready"].astype(np.float64)


class Scenario(Bench):
    """A robot that follows its commands late, seen through encoders that now and then fail."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.name = str(self.rng.choice(sorted(robots.names())))
        limits, dims, self.body = limits_of(self.name)
        self.body = self.body.copy()
        super().__init__({"kind": str(self.rng.choice(["async", "naive", "ensemble"]))}, limits, dims)
        self.measured = self.body
        self.places = limits.places
        self.pushed: Float64 | None = None  # where a hand moves the arm to
        self.fault, self.since, self.kept = "", 0, self.body
        self.sound = 0  # ticks without a fault
        self.run_number = self.chunks = 0
        self.previous: Float64 | None = None
        self.velocity = np.zeros(self.dim)
        self.violations: list[str] = []

    # --- what happens --------------------------------------------------------------------------------------

    def happen(self) -> None:
        """Something, now and then."""
        if self.rng.random() < 0.06:
            kind = self.rng.choice(["follow", "motion", "hold", "estop", "clear", "push", "sim"])
            getattr(self, f"_{kind}")()
        self.sound = 0 if self.fault else self.sound + 1
        # The first samples, and those after a gap, cannot be told from sound ones by their numbers.
        if self.sound > _SOUND and self.rng.random() < 0.05:
            self.fault, self.since = str(self.rng.choice([*_FAULTS, *_KEPT])), 0
            free = np.where(self.places & (self.rng.random(self.dim) < 0.5), self._somewhere(1.0), self.body)
            self.kept = self.body.copy() if self.fault == "frozen" else free
        elif self.fault and self.rng.random() < 0.1:
            self.fault = ""
        if self.run_number and self.rng.random() < 0.3:
            self._chunk()

    def _somewhere(self, reach: float) -> Float64:
        near = self.body + self.rng.uniform(-reach, reach, self.dim)
        place = np.clip(near, self.limits.lower, self.limits.upper)
        return np.asarray(np.where(self.places, place, self.body))

    def _follow(self) -> None:
        self.run_number += 1
        self.say("follow", run=self.run_number)

    def _motion(self) -> None:
        self.say("motion", goal=self._somewhere(0.6), speed=1.0)

    def _hold(self) -> None:
        self.say("hold", run=self.run_number)

    def _sim(self) -> None:
        self.run_number += 1
        self.say("follow", run=self.run_number, mode="sim")

    def _estop(self) -> None:
        self.page.set_estop(EStop.LATCHED)

    def _clear(self) -> None:
        self.page.set_estop(EStop.CLEAR)

    def _push(self) -> None:
        self.pushed = self._somewhere(1.2) if self.rng.random() < 0.5 else None

    def _chunk(self) -> None:
        self.chunks += 1
        start = np.array(self.status["commanded"], np.float64)
        way = np.linspace(start, self._somewhere(0.3), 30)
        self.chunk(self.chunks, way, run=self.run_number)

    # --- one tick ------------------------------------------------------------------------------------------

    def read(self) -> Float64:
        """What the encoders say."""
        sound = self.body + self.rng.normal(0.0, _NOISE, self.dim) * self.places
        if not self.fault:
            return sound
        self.since += 1
        if self.fault in _KEPT:
            return np.where(self.kept != self.body, self.kept, sound) if self.fault == "stuck" else self.kept
        faulty = _FAULTS[self.fault](self.rng, sound, self.since - 1)
        return np.asarray(np.where(self.places, faulty, sound))

    def go(self) -> None:
        """One tick: the robot is seen, told, and moves."""
        self._begun = True
        for process in ("main", "guard"):
            self.page.beat(process, self.clock.now())
        self.happen()
        self.observe(qpos=self.read().astype(np.float32))
        before = len(self.sink.sent)
        self.tick(self.step, self.clock.now())
        self.look(self.sent[before:])
        self.step += 1
        self.clock.advance(PERIOD)
        goal = self.pushed if self.pushed is not None else self.previous
        if goal is not None:
            most = self.limits.velocity * PERIOD
            follow = self.body + np.clip(0.6 * (goal - self.body), -most, most)
            self.body = np.where(self.places, follow, goal if self.pushed is None else self.body)

    def look(self, sent: Float64) -> None:
        """What is wrong with what was sent in this tick."""
        record = self.records()[-1]
        if len(sent) > 1:
            self._wrong("told twice in one tick")
        if not len(sent):
            self.previous, self.velocity = None, np.zeros(self.dim)
            return
        told = sent[0]
        if not np.isfinite(told).all() or (self.limits.outside(told) > 1e-5 * self.limits.reach).any():
            self._wrong(f"beyond the limits or no number: {told.tolist()}")
        if self.previous is not None:
            self._compare(told, self.previous, " ".join(record.notes), record.source == "estop")
        elif (np.abs(told - self.body) > _NEAR)[self.places].any():
            self._wrong("taken over where it is not")
        self.previous = told

    def _compare(self, told: Float64, before: Float64, notes: str, stopped: bool) -> None:
        moved = (told - before) / PERIOD
        if "stepped" in notes:
            hardest = 60.0 * self.limits.reach * _MARGIN * PERIOD
            self.velocity = np.clip(moved, -hardest, hardest)  # it may have moved on from there
            apart = np.abs(told - before) > 1e-6
            away = np.abs(told - self.body) > np.maximum(np.abs(before - self.body), _NEAR)
            if (apart & away)[self.places].any():
                self._wrong(f"stepped away from the robot: {notes}")
            return
        free = ~self.limits.binary
        if (np.abs(moved) > self.limits.velocity * _MARGIN + 1e-3 * self.limits.reach)[free].any():
            self._wrong(f"faster than it moves: {moved.tolist()} {notes}")
        least, most = self.velocity, self.velocity
        if stopped:
            least, most = np.minimum(least, 0.0), np.maximum(most, 0.0)
            free = free & self.places
        gain = 60.0 * self.limits.reach * _MARGIN * PERIOD + 1e-2 * self.limits.reach
        edge = (told <= self.limits.lower + 1e-6) | (told >= self.limits.upper - 1e-6)
        if ((moved > most + gain) | (moved < least - gain))[free & ~edge].any():
            self._wrong(f"harder than it accelerates: {notes}")
        self.velocity = moved

    def _wrong(self, what: str) -> None:
        doing = f"{self.name}, tick {self.step}, {self.behaviour}, encoders {self.fault or 'sound'}"
        self.violations.append(f"{doing}: {what}")


def once(seed: int) -> list[str]:
    """What goes wrong in the scenario of `seed`, in words; [] where nothing does."""
    scenario = Scenario(seed)
    for _ in range(_TICKS):
        scenario.go()
    return [f"seed {seed}: {violation}" for violation in scenario.violations]
