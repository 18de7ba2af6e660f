"""Checks of a draft: problems that prevent freezing, and remarks, each with the step of the form that fixes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from django.core.exceptions import ValidationError

from evaweb.blinding.visibility import Visibility
from evaweb.core.errors import EvaError
from evaweb.plans.counting import ENDS
from evaweb.plans.design import check_drafted, planned
from evaweb.plans.models import Allocation, Comparing, CountsAs, Plan, PrimaryOutcome, StoppingRule
from evaweb.plans.schedule import Condition, check_schedule
from evaweb.statistics.difference import barnard
from evaweb.statistics.planning import approximate_power
from evaweb.trials.models import Milestone, Scene
from evaweb.trials.tables import check_strategy
from runtime.benches.schema import UnusableBench

_ENOUGH = 20  # pairs that, if all are won by one checkpoint, are significant at any alpha allowed
_GAIN = (0.5, 0.7)  # success rates whose difference a plan should find
_LIKELY = 0.5  # power below which a plan probably decides nothing


@dataclass(frozen=True, slots=True)
class Remark:
    """Message about a draft, and the step of its page at which the cause can be changed."""

    step: str
    text: str


def problems(plan: Plan) -> Iterator[Remark]:
    """Yield everything that prevents freezing the plan.

    A random order that does not fit the design is no problem, because freezing draws another order.
    """
    chosen = set(plan.checkpoints.values_list("pk", flat=True))
    if not plan.positions.exists():
        yield Remark("conditions", f"{plan} has no position: choose initial conditions")
    if not chosen:
        yield Remark("arms", f"{plan} has no checkpoint: choose at least one")
    for off in plan.checkpoints.filter(active=False):
        yield Remark("arms", f"checkpoint {off} is switched off")
    yield from _served(plan)
    compared = list(_comparisons(plan, chosen))
    yield from compared
    if chosen and plan.positions.exists() and not compared:
        yield from _designed(plan)


def _served(plan: Plan) -> Iterator[Remark]:
    """Yield strategies that stations would refuse, and conflicts between the strategies of plan and checkpoints."""
    try:
        check_strategy(plan.strategy)
    except ValidationError as error:  # the draft predates this validation
        yield Remark("design", f"strategy: {'; '.join(error.messages)}")
    own = [str(row) for row in plan.checkpoints.filter(strategy__isnull=False)]
    if plan.strategy is not None and own:
        yield Remark(
            "arms", f"the plan has a strategy for all trials, and one of their own have: {', '.join(own)}"
        )


def covered(plan: Plan, sight: Visibility) -> Callable[[str], str]:
    """Return a function that takes a message and covers the names of checkpoints in it.

    The function replaces the names of those checkpoints that are hidden from the user with this `sight`.
    """
    rows = [*plan.checkpoints.filter(pk__in=sight.checkpoints), *filter(None, (plan.first, plan.second))]
    names = sorted({row.name for row in rows if row.pk in sight.checkpoints}, key=len, reverse=True)

    def told(text: str) -> str:
        for name in names:
            text = text.replace(name, "a hidden checkpoint")
        return text

    return told


def _designed(plan: Plan) -> Iterator[Remark]:
    names = [row.name for row in plan.checkpoints.all()]
    conditions = [
        Condition(scene, number) for scene, number in plan.positions.values_list("scene__name", "number")
    ]
    try:
        check_schedule(names, conditions, plan.repetitions, plan.allocation)
        check_drafted(plan)
    except EvaError as error:
        yield Remark("design", str(error))


def _comparisons(plan: Plan, chosen: set[int]) -> Iterator[Remark]:
    named = [row for row in (plan.first, plan.second) if row]
    named_counts = {Comparing.CONTROL: (1, "the first one alone"), Comparing.ALL: (0, "none by name")}
    if plan.comparing in named_counts:
        number, text = named_counts[Comparing(plan.comparing)]
        if number and not named:
            yield Remark("arms", "no control is chosen (first), with which each checkpoint is compared")
        elif len(named) != number or (number and plan.first is None):
            yield Remark("arms", f"comparisons of {plan.get_comparing_display()} name {text}")
        anchors = plan.checkpoints.filter(anchor=True) if plan.comparing == Comparing.ALL else ()
        if len(chosen - {row.pk for row in anchors}) < 2:
            yield Remark(
                "arms", f"comparisons of {plan.get_comparing_display()} need two checkpoints or more"
            )
    elif len(named) == 1 or (named and named[0] == named[1]):
        yield Remark("arms", "the comparison needs two checkpoints, or none")
    for row in named:
        if row.pk not in chosen:
            yield Remark("arms", f"the comparison is about {row}, which is not one of the plan's checkpoints")
    failing = [text for name, text in ENDS.items() if getattr(plan, name) == CountsAs.FAILURE]
    if plan.outcome == PrimaryOutcome.SCORE and failing:
        yield Remark(
            "design",
            f"the comparison is about scores, and {', '.join(failing)} counts as a failure, which keeps its partial "
            "credit; allowed: judged or repeated, or the comparison about success",
        )
    if plan.comparing == Comparing.ALL and plan.margin is not None:
        yield Remark(
            "arms",
            "margin with comparisons of all checkpoints with each other: it asks of one whether it is not worse than "
            "another; allowed with: first and second, each checkpoint with the first",
        )
    designed = (
        plan.stopping != StoppingRule.NONE
        or plan.margin is not None
        or plan.outcome != PrimaryOutcome.SUCCESS
        or plan.allocation != Allocation.PAIRED
        or plan.drop_arms
    )
    if designed and not planned(plan):
        yield Remark(
            "arms",
            "a design with looks, a margin, a score, random order or dropped checkpoints needs the comparison that it "
            "is about",
        )


def _finds_nothing(plan: Plan) -> str:
    """Return a message if even the clearest outcome of all trials could not be significant, else ""."""
    n, comparisons = plan.positions.count() * plan.repetitions, len(planned(plan))
    if (
        not (comparisons and 0 < n <= _ENOUGH)
        or plan.margin is not None
        or plan.allocation != Allocation.PAIRED
    ):
        return ""
    p = 2.0 ** (1 - n) if plan.outcome == PrimaryOutcome.SCORE else barnard(n, n, 0, n).p
    share = plan.alpha / comparisons
    if p <= share:
        return ""
    return (
        f"{n} pair{'s' if n > 1 else ''} find nothing: even if one checkpoint won all of them, p = {p:.2g} is above "
        f"{share:.2g}."
    )


def _finds_little(plan: Plan) -> str:
    """Return a message if the plan would probably miss even a gain of _GAIN, else ""."""
    n, comparisons = plan.positions.count() * plan.repetitions, len(planned(plan))
    if not comparisons or not n or plan.margin is not None or plan.outcome != PrimaryOutcome.SUCCESS:
        return ""
    power = approximate_power(n, *_GAIN, plan.alpha / comparisons)
    if power >= _LIKELY:
        return ""
    low, high = _GAIN
    return (
        f"{n} trials of each checkpoint probably decide nothing: success in {100 * high:.0f} instead of "
        f"{100 * low:.0f} of 100 trials is found in about {100 * power:.0f} of 100 such evaluations, more with more "
        "trials at each position."
    )


def thoughts(plan: Plan) -> Iterator[Remark]:
    """Yield remarks on allowed choices that a reader of the result may question."""
    if not plan.question.strip():
        yield Remark(
            "question", "No question is written down: a result is then an answer to whatever is asked later."
        )
    if plan.checkpoints.exists() and not planned(plan):
        yield Remark(
            "arms", "No comparison is planned: the result describes each checkpoint and decides nothing."
        )
    unnamed = list(plan.checkpoints.filter(digest=""))
    if unnamed:
        names = ", ".join(map(str, unnamed))
        yield Remark(
            "arms", f"No digest of the weights: {names}. Other weights under the same name go unnoticed."
        )
    for scene in Scene.objects.filter(positions__plan=plan).distinct():
        if not scene.criterion.strip():
            yield Remark("conditions", f"Scene {scene} has no written criterion of success.")
        if not scene.milestones.exists():
            yield Remark("conditions", f"Scene {scene} has no milestones: every score is 0 or 1.")
        if not scene.active:
            yield Remark("conditions", f"Scene {scene} is switched off.")
    if plan.positions.count() == 1:
        yield Remark("conditions", "Only one position: the result says nothing about any other.")
    for station in plan.stations.filter(active=False):
        yield Remark("conditions", f"Station {station} is switched off.")
    if few := _finds_nothing(plan) or _finds_little(plan):
        yield Remark("design", few)
    yield from _unreported(plan)
    if not plan.blind:
        yield Remark("design", "The plan is open: operators see which checkpoint runs, and may favour one.")
    if not plan.second_rater_share:
        yield Remark("design", "No trial is scored a second time: how well raters agree is not known.")


def _unreported(plan: Plan) -> Iterator[Remark]:
    """Yield a remark for each milestone that the simulated bench of its scene does not report."""
    told = Milestone.objects.filter(scene__positions__plan=plan).exclude(truth="").select_related("scene")
    for milestone in told.distinct():
        scene = milestone.scene
        try:
            reported = scene.schema.milestones
        except UnusableBench as error:
            yield Remark("conditions", f"Scene {scene}: {error}.")
            continue
        if milestone.truth not in reported:
            yield Remark(
                "conditions",
                f"Milestone “{milestone}” of scene {scene} is what a bench reports as “{milestone.truth}”: "
                f"the simulated bench {scene.bench} reports {', '.join(reported)}.",
            )
