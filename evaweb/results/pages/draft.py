"""Contents of a draft's page: its steps, what is missing at each, example schedule, and power."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from django.contrib.auth.models import User

from evaweb.accounts.roles import Role
from evaweb.blinding.visibility import Visibility
from evaweb.plans.counting import ENDS
from evaweb.plans.design import planned
from evaweb.plans.draft_checks import Remark, covered, problems, thoughts
from evaweb.plans.drafting import HIDDEN, Values
from evaweb.plans.models import Allocation, Comparing, Plan, PrimaryOutcome, Reference, StoppingRule
from evaweb.plans.schedule import IMBALANCE, Condition, foretold, schedule
from evaweb.plans.seeded_draws import KEY_BYTES
from evaweb.results.analysis.planner import Question
from evaweb.results.analysis.power import Figures, PowerRequest
from evaweb.results.presentation.drawings import time_courses
from evaweb.results.templatetags.results_tags import design_text
from evaweb.stations.models import Station
from evaweb.statistics.designs import RULES
from evaweb.statistics.score_courses import LARGEST, Scores
from evaweb.trials.models import Position, Scene
from evaweb.trials.selectors import checkpoint_list

STEPS = {
    "question": "Question",
    "arms": "Arms",
    "conditions": "Conditions",
    "design": "Design",
    "schedule": "Schedule",
    "checks": "Checks",
    "freeze": "Freeze",
}
_BLOCKS = 6  # blocks of the example schedule
_EXAMPLE = bytes(KEY_BYTES)  # fixed, so that the example stays the same; freezing draws a random key


@dataclass(frozen=True, slots=True)
class Step:
    """Step of drafting a plan, as shown on the draft's page.

    If it is not `done`, `words` says what is missing, and `blocks` is True if the plan cannot be frozen until then.
    """

    name: str
    title: str
    done: bool
    words: str
    blocks: bool

    @property
    def tone(self) -> str:
        """State colour, by its name in the style sheets."""
        return "warn" if self.blocks else "ok" if self.done else "neutral"


@dataclass(frozen=True, slots=True)
class Size:
    """Size of a plan: positions, checkpoints, trials per checkpoint at all positions, trials in total."""

    positions: int
    checkpoints: int
    each: int
    total: int

    @classmethod
    def of(cls, plan: Plan) -> Size:
        """Return the size of a draft."""
        positions, checkpoints = plan.positions.count(), plan.checkpoints.count()
        per_checkpoint = positions * plan.repetitions
        return cls(positions, checkpoints, per_checkpoint, per_checkpoint * checkpoints)


def state_page(
    plan: Plan, sight: Visibility, *, faults: Mapping[str, str], agreed: bool, cycle_s: float
) -> dict[str, Any]:
    """Return the contents that follow from the draft: steps, schedule, checks, and whether it can be frozen.

    Args:
        plan: The draft as it is saved.
        sight: Visibility of the user.
        faults: Messages by field for inputs that are not saved.
        agreed: Whether the page shows exactly what is saved.
        cycle_s: Assumed duration of a trial [s].
    """
    cover = covered(plan, sight)
    inway = [Remark(row.step, cover(row.text)) for row in problems(plan)]
    considered = [Remark(row.step, cover(row.text)) for row in thoughts(plan)]
    size = Size.of(plan)
    return {
        "plan": plan,
        "steps": _steps(plan, inway, considered, faults, agreed),
        "problems": inway,
        "thoughts": considered,
        "size": size,
        "cycle_s": cycle_s,
        "hours": size.total * cycle_s / 3600,
        "preview": _preview(plan, size) if not inway else None,
        "summary": list(_summary(plan, size, cover, cycle_s)) if not inway else (),
        "freezable": not inway and not faults and agreed,
    }


def _steps(
    plan: Plan, inway: list[Remark], considered: list[Remark], faults: Mapping[str, str], agreed: bool
) -> list[Step]:
    missing = Counter(row.step for row in inway)
    missing.update(_step_of(name) for name in faults)
    first = {row.step: row.text for row in reversed(inway)}

    def own(name: str) -> tuple[bool, str]:
        if name == "question":
            return bool(plan.question.strip()), "no question yet"
        if name == "arms":
            return bool(planned(plan)), "no comparison yet"
        if name == "schedule":
            return not inway, "not yet known"
        if name == "checks":
            n = len(inway)
            label = f"{n} to fix" if n else f"{len(considered)} to consider"
            return not inway and not considered, label
        if name == "freeze":
            ready = "ready to freeze" if planned(plan) else "ready, but compares nothing"
            return False, ready if not inway and not faults and agreed else "not yet"
        return True, ""

    rows = []
    for name, title in STEPS.items():
        complete, label = own(name)
        if missing[name]:
            complete, label = False, f"{missing[name]} to fix" if name not in first else _short(first[name])
        blocks = bool(missing[name]) or (name in ("schedule", "checks") and bool(inway))
        rows.append(Step(name, title, complete, "" if complete else label, blocks))
    return rows


_SHORT = {"has no position": "no position yet", "has no checkpoint": "no checkpoint yet"}


def _short(text: str) -> str:
    return next((label for part, label in _SHORT.items() if part in text), "to mend")


_FIELDS = {
    "question": ("title", "question", "owner", "kind", "margin", "outcome"),
    "arms": ("checkpoints", "control", "challenger", "comparing"),
    "conditions": ("positions", "stations"),
}


def _step_of(field: str) -> str:
    return next((step for step, fields in _FIELDS.items() if field in fields), "design")


def _summary(
    plan: Plan, size: Size, cover: Callable[[str], str], cycle_s: float
) -> Iterator[tuple[str, str]]:
    """Yield the properties of the plan that a freeze asks to confirm."""
    names = plan.checkpoints.order_by("name").values_list("name", flat=True)
    pairs = [f"{first} with {second}" for first, second in planned(plan)]
    scenes = plan.positions.values("scene").distinct().count()
    yield "Checkpoints", cover(", ".join(names))
    yield "Compared", cover("; ".join(pairs)) or "nothing: no comparison is chosen"
    yield "Positions", f"{size.positions} of {scenes} scene{'s' if scenes > 1 else ''}"
    hours = size.total * cycle_s / 3600
    yield "Trials", f"{size.each} of each checkpoint, {size.total} in all: {hours:.1f} robot hours"
    if pairs:
        drops = ", checkpoints found worse are dropped" if plan.drop_arms else ""
        yield "Design", f"{design_text(plan.stopping)}, alpha {plan.alpha:g}{drops}"
    yield (
        "Blind",
        "yes: these checkpoints leave everybody's lists and choices, yours too, until the reveal"
        if plan.blind
        else "no: everybody sees which checkpoint runs",
    )


def planned_facts(plan: Plan) -> dict[str, Any]:
    """Return what a frozen plan was to do: its positions by scene, its trials, and its design ("" without one)."""
    rows = list(plan.positions.order_by("scene__title", "number").values_list("scene__title", "number"))
    each = len(rows) * plan.repetitions
    return {
        "each": each,
        "total": each * plan.checkpoints.count(),
        "scenes": [
            (title, ", ".join(str(number) for _, number in group))
            for title, group in groupby(rows, key=lambda row: row[0])
        ],
        "design": f"{design_text(plan.stopping)}, alpha {plan.alpha:g}" if planned(plan) else "",
    }


def _preview(plan: Plan, size: Size) -> dict[str, Any]:
    """Return an example of the first blocks; the actual order of positions and trials is drawn by the freeze."""
    conditions = [
        Condition(scene, number)
        for scene, number in plan.positions.order_by("scene__name", "number").values_list(
            "scene__title", "number"
        )
    ]
    names = [
        str(number) for number in range(size.checkpoints)
    ]  # the structure of a block does not depend on the names
    rounds = min(plan.repetitions, -(-_BLOCKS // len(conditions)))
    units = schedule(
        checkpoints=names, conditions=conditions, repetitions=rounds, key=_EXAMPLE, allocation=plan.allocation
    )
    blocks = [(number, list(block)) for number, block in groupby(units, key=lambda unit: unit.block)]
    stations = plan.stations.count()
    paired = plan.allocation == Allocation.PAIRED
    return {
        "blocks": [(number + 1, block[0].condition, len(block)) for number, block in blocks[:_BLOCKS]],
        "count": size.each,
        "paired": paired,
        "ahead": IMBALANCE,
        "per_position": plan.repetitions if paired else 2 * plan.repetitions,
        "foretold": foretold(size.checkpoints, plan.allocation),
        "stations": stations,
        "per_station": size.each // stations if stations else None,
    }


def choices_page(plan: Plan, sight: Visibility, values: Values) -> dict[str, Any]:
    """Return the checkpoints, positions, stations and owners that the page offers, and the selected `values`."""
    chosen = set(values["checkpoints"])
    offered = list(checkpoint_list(all_of_them=True, sight=sight))
    positions = Position.objects.select_related("scene").order_by("scene__title", "number")
    listed = [row for row in positions if row.scene.active or row.pk in values["positions"]]
    pictures = _pictures(listed)
    scenes = groupby(listed, key=lambda row: row.scene)
    stations = Station.objects.order_by("name")
    return {
        "values": values,
        "checkpoints": [row for row in offered if row.active or row.pk in chosen],
        "hidden": plan.checkpoints.filter(pk__in=sight.checkpoints).count(),
        "hidden_word": HIDDEN,
        "scenes": [(scene, [(row, pictures.get(row.pk, "")) for row in rows]) for scene, rows in scenes],
        "stations": [row for row in stations if row.active or row.pk in values["stations"]],
        "owners": User.objects.filter(is_active=True, groups__name__in=(Role.OPERATOR, Role.ADMIN))
        .union(User.objects.filter(pk=plan.owner_id), User.objects.filter(is_superuser=True, is_active=True))
        .order_by("username"),
        "designs": [
            (rule, design_text(rule), str(StoppingRule(rule).label).partition(": ")[2]) for rule in RULES
        ],
        "comparings": (
            (Comparing.PAIR, "Two: one checkpoint with the control"),
            (Comparing.CONTROL, "Each checkpoint with the control"),
            (Comparing.ALL, "All checkpoints with each other"),
        ),
        "outcomes": PrimaryOutcome.choices,
        "ends": [_end(name, values[name]) for name in ENDS],
    }


def _end(name: str, value: str) -> tuple[str, str, Any, str]:
    field: Any = Plan._meta.get_field(name)
    return name, field.verbose_name, field.choices, value


def value_text(name: str, value: Any, sight: Visibility) -> str:
    """Return a value of a draft as text."""
    if value in (None, "", []):
        return "nothing"
    if isinstance(value, list):
        return ", ".join(map(str, value)) if name == "look_after" else f"{len(value)} chosen"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if name in ("control", "challenger"):
        row = (
            checkpoint_list(all_of_them=True, sight=sight).filter(pk=value).first()
            if value != HIDDEN
            else None
        )
        return row.name if row else "a hidden checkpoint"
    if name == "owner":
        return User.objects.get(pk=value).get_username()
    return str(value)[:80]


def _pictures(positions: Iterable[Position]) -> dict[int, str]:
    """Return for each position the newest reference image of the first camera that has one."""
    rows = Reference.objects.filter(position__in=list(positions)).order_by("camera", "-pk")
    pictures: dict[int, str] = {}
    for position, picture in rows.values_list("position", "picture"):
        pictures.setdefault(position, picture)
    return pictures


def power_request(plan: Plan, question: Question, spread: float) -> PowerRequest | None:
    """Return the request for the draft's power; None if the draft compares nothing, or plans no trial.

    `spread` is the assumed standard deviation of scores, if these are compared.
    """
    comparisons, size = len(planned(plan)), Size.of(plan)
    if not comparisons or not size.each:
        return None
    interim_tests = tuple(plan.look_after)
    share = plan.alpha / comparisons
    scores = None
    if plan.outcome == PrimaryOutcome.SCORE:
        scores = Scores(question.better, question.rate, spread, _points(plan))
    return PowerRequest(
        plan.stopping, size.each, share, plan.margin, interim_tests, question, comparisons == 1, scores
    )


def _points(plan: Plan) -> int:
    """Return the number of points of a score at the draft's scene with the fewest; 1 means success or failure only."""
    scenes = Scene.objects.filter(positions__in=plan.positions.all()).distinct()
    points = [sum(scene.milestones.values_list("points", flat=True)) or 1 for scene in scenes]
    return min([LARGEST, *points])


def question_for(plan: Plan, given: Question) -> Question:
    """Return the calculator's input with the values that the draft defines itself."""
    size, stations = Size.of(plan), max(1, plan.stations.count())
    return Question(
        given.rate,
        given.better,
        plan.alpha,
        given.power,
        given.cycle_s,
        max(2, size.checkpoints),
        plan.comparing,
        stations,
        given.hours,
    )


def power_page(plan: Plan, asked: PowerRequest, found: Figures) -> dict[str, Any]:
    """Return the figure of power and the table of designs, with the values computed so far."""
    size, question = Size.of(plan), asked.question
    at = found.planned(asked)
    curves = [
        (RULES.index(rule), design_text(rule), [(point.pairs, point.power) for point in found.curves[rule]])
        for rule in RULES
        if rule in found.curves and (len(found.curves[rule]) > 1 or rule in at)
    ]
    hours = question.cycle_s / 3600
    return {
        "asked": asked,
        "found": found,
        "percent": round(100 * found.done / found.of),
        "figure": time_courses.power(curves, asked.pairs, question.power, asked.numbers[-1]),
        "planned": at.get(asked.rule),
        "most_hours": size.total * hours,
        "mean_hours": at[asked.rule].mean * size.checkpoints * hours
        if asked.rule in at and asked.alone
        else None,
        "table": [
            {
                "rule": rule,
                "at": at.get(rule),
                "need": need,
                "repetitions": -(-need["pairs"] // size.positions) if need and need["pairs"] else None,
            }
            for rule in asked.rules
            for need in (found.needs.get(rule),)
        ],
        "size": size,
        "question": question,
        "stations": question.stations,
        "scores": asked.scores,
        "narrowed": asked.scores is not None
        and any(abs(point - asked.scores.spread) > 0.005 for point in asked.scores.spreads()),
        "random": plan.allocation == Allocation.RANDOM,
        "comparisons": len(planned(plan)),
    }
