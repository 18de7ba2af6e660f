"""Power of a draft's design at assumed rates, computed in the background and shown as far as it is available.

One thread per web process computes it, value by value. A computation that nobody requests any more is abandoned
between two values; computed values are cached.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from threading import Condition
from typing import Any

from evaweb.results.analysis.planner import Question, design_for_power
from evaweb.serving import computations
from evaweb.statistics import score_courses
from evaweb.statistics.base import StatisticsError
from evaweb.statistics.boundaries import MOST
from evaweb.statistics.design_power import DesignPower, design_power, pairs_needed
from evaweb.statistics.designs import ANYTIME, RULES
from evaweb.statistics.score_courses import Scores, score_course, score_pairs_needed

log = logging.getLogger(__name__)
_STEPS = 12  # points of a curve
_LEAST = 40  # least range of a curve [trials per arm]
_GIVEN_UP_S = 10.0  # time after the last request
_KEPT = 64


@dataclass(frozen=True, slots=True)
class PowerRequest:
    """Request for the power of a design with `pairs` pairs at assumed rates.

    Attributes:
        rule: Selected kind of design.
        alpha: Alpha of each comparison.
        margin: Margin of non-inferiority, None without one.
        looks: Numbers of pairs after which the selected design tests.
        question: Assumed rates (the weaker one is the control's), wanted power, and times.
        alone: Whether the plan has a single comparison.
        scores: If given, scores are compared instead of successes, and the rates are their means.
    """

    rule: str
    pairs: int
    alpha: float
    margin: float | None
    looks: tuple[int, ...]
    question: Question
    alone: bool
    scores: Scores | None = None

    @property
    def rules(self) -> tuple[str, ...]:
        """Designs that may be selected for this request, the selected one first."""
        if self.scores is not None:
            return (self.rule, *(rule for rule in score_courses.RULES if rule != self.rule))
        other_rules = (
            rule for rule in RULES if rule != self.rule and (self.margin is None or rule != ANYTIME)
        )
        return (self.rule, *other_rules)

    @property
    def numbers(self) -> list[int]:
        """Numbers of trials per arm at which curves are computed, including the planned number."""
        end = min(MOST, max(_LEAST, round(1.6 * self.pairs)))
        numbers = {max(2, round(end * step / _STEPS)) for step in range(1, _STEPS + 1)}
        return sorted(numbers | ({self.pairs} if 2 <= self.pairs <= MOST else set()))

    def at(self, rule: str, pairs: int) -> DesignPower:
        """Return the power of a design by `rule` with `pairs` pairs.

        The requested looks are scaled in proportion to the number of pairs.
        """
        if self.scores is not None:
            return _computed(score_course, rule, pairs, self.scores, self.alpha)
        interim_tests = self.looks if rule == self.rule else ()
        scaled = tuple(sorted({max(1, round(number * pairs / self.pairs)) for number in interim_tests}))
        new, control = self.question.better, self.question.rate
        return _computed(design_power, rule, pairs, new, control, self.alpha, self.margin, scaled)


@dataclass(frozen=True, slots=True)
class Figures:
    """Power of each design, and the trials that it needs, as far as they are computed already.

    `curves` maps each design to its power at ascending numbers of pairs. `needs` maps each design to the trials that it
    needs for the wanted power.
    """

    curves: dict[str, tuple[DesignPower, ...]] = field(default_factory=dict)
    needs: dict[str, dict[str, Any]] = field(default_factory=dict)
    done: int = 0
    of: int = 1
    fault: str = ""

    @property
    def whole(self) -> bool:
        """Whether the results are complete."""
        return bool(self.fault) or self.done == self.of

    def planned(self, asked: PowerRequest) -> dict[str, DesignPower]:
        """Return the power at the planned number of trials, by design."""
        points = ((rule, point) for rule, curve in self.curves.items() for point in curve)
        return {rule: point for rule, point in points if point.pairs == asked.pairs}


def _computed(work: Callable[..., Any], *given: Any) -> Any:
    """Run `work(*given)` outside the web process and return its result.

    Each person gets a share of the computing time. All drafts together use the share of one person, because they are
    computed one after the other.
    """
    return computations.questions.compute("drafts", work, *given)


_Step = Callable[[Figures], Figures]


def _steps(request: PowerRequest) -> Iterator[_Step]:
    """Yield the computation's steps in the order of their importance for the page.

    That order is: the selected design, the other designs at the planned number, what each design needs, and the other
    designs' remaining points.
    """
    planned = [request.pairs] if request.pairs in request.numbers else []
    yield from (_point(request, request.rule, number) for number in [*planned, *request.numbers])
    other_rules = request.rules[1:]
    yield from (_point(request, rule, number) for rule in other_rules for number in planned)
    if request.margin is None:
        yield from (_need(request, rule) for rule in request.rules)
    yield from (_point(request, rule, number) for rule in other_rules for number in request.numbers)


def _point(request: PowerRequest, rule: str, number: int) -> _Step:
    def step(so_far: Figures) -> Figures:
        points = {point.pairs: point for point in so_far.curves.get(rule, ())} | {
            number: request.at(rule, number)
        }
        curve = tuple(points[pairs] for pairs in sorted(points))
        return replace(so_far, curves={**so_far.curves, rule: curve})

    return step


def _need(request: PowerRequest, rule: str) -> _Step:
    def step(so_far: Figures) -> Figures:
        question = request.question
        if request.scores is None:
            need = _computed(
                pairs_needed, rule, question.rate, question.better, question.power, request.alpha
            )
        else:
            need = _computed(score_pairs_needed, rule, request.scores, question.power, request.alpha)
        row = design_for_power(question, rule, need, alone=request.alone)
        return replace(so_far, needs={**so_far.needs, rule: row})

    return step


class _Desk:
    """Queue of requests; of each person only the newest request is computed."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._found: OrderedDict[PowerRequest, Figures] = OrderedDict()
        self._newest: dict[Hashable, tuple[PowerRequest, float]] = {}
        self._under_way: set[PowerRequest] = set()
        self._thread = ThreadPoolExecutor(1, "power")

    def query(self, person: Hashable, asked: PowerRequest, patience_s: float) -> Figures:
        """Return the results so far, after at most `patience_s` [s] or as soon as they are complete."""
        with self._changed:
            self._newest[person] = (asked, time.monotonic())
            if asked not in self._found:
                self._found[asked] = Figures()
            self._found.move_to_end(asked)
            if asked not in self._under_way and not self._found[asked].whole:
                self._under_way.add(asked)
                self._thread.submit(self._compute, asked)
            self._changed.wait_for(lambda: self._found[asked].whole, patience_s)
            while len(self._found) > _KEPT:
                self._found.popitem(last=False)
            return self._found.get(asked, Figures())

    def _wanted(self, request: PowerRequest) -> bool:
        since = time.monotonic() - _GIVEN_UP_S
        self._newest = {person: row for person, row in self._newest.items() if row[1] > since}
        return any(newest == request for newest, _ in self._newest.values())

    def _compute(self, request: PowerRequest) -> None:
        steps = list(_steps(request))
        for number, step in enumerate(steps, start=1):
            with self._changed:
                so_far = self._found.get(request)
                if so_far is None or not self._wanted(request):
                    self._under_way.discard(request)
                    return
            if number <= so_far.done:  # computed before it was abandoned
                continue
            try:
                figures = replace(step(so_far), done=number, of=len(steps))
            except StatisticsError as error:
                figures = replace(so_far, fault=str(error))
            except Exception:
                log.exception("power of %s", request)
                figures = replace(so_far, fault="it could not be computed: see the log of the web")
            with self._changed:
                self._found[request] = figures
                self._changed.notify_all()
                if figures.whole:
                    self._under_way.discard(request)
            if figures.fault:
                return


_desk = _Desk()


def figures(person: Hashable, asked: PowerRequest, patience_s: float = 0.5) -> Figures:
    """Return the results so far; the computation continues as long as the person repeats the request."""
    return _desk.query(person, asked, patience_s)
