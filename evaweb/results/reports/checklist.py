"""Reviewer's checklist of an evaluation, answered from the record alone, never by a person's claim."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from django.db.models import Count, F, Min

from evaweb.plans.design import compared
from evaweb.plans.models import Allocation, Plan
from evaweb.plans.schedule import IMBALANCE
from evaweb.plans.selectors import needed_handouts
from evaweb.results.analysis.analysis import Analysis
from evaweb.results.analysis.conduct import looked_behind
from evaweb.results.analysis.integrity import CATEGORY, VERDICT, with_changes
from evaweb.results.models import Rating
from evaweb.results.presentation.plan_result import PlanResult
from evaweb.statistics.designs import findings
from evaweb.trials.models import Score, Trial, TrialStatus


@dataclass(frozen=True, slots=True)
class Item:
    """Practice, whether it was followed ("yes", "partly", "no"), and the evidence in the record."""

    practice: str
    kept: str
    record: str


def checklist(result: PlanResult) -> list[Item]:
    """Return all items of the checklist."""
    plan, analysis = result.plan, result.analysis
    trials = Trial.objects.filter(evaluation=plan.evaluation_id)
    return [
        _preregistration(plan, trials),
        _criteria(plan),
        _versions(plan),
        _order(plan),
        _blind(plan),
        _complete(result, trials),
        _voids(plan, trials),
        _corrections(plan),
        _second_rater(plan, trials),
        _narrative(analysis),
        _recorded(trials),
        _configurations(trials),
        Item(
            "Rates with n and interval; all pairs corrected for how many there are",
            "yes",
            f"95 % Wilson and Clopper-Pearson; Holm over {len(analysis.comparisons)} comparisons",
        ),
        _spread(trials),
    ]


def _yes_or_no(fulfilled: bool) -> str:
    return "yes" if fulfilled else "no"


def _preregistration(plan: Plan, trials) -> Item:  # type: ignore[no-untyped-def]
    begun = trials.aggregate(first=Min("prepared_at"))["first"]
    before = bool(plan.frozen_at and (begun is None or plan.frozen_at <= begun))
    names = compared(plan.document or {})
    complete = bool(plan.question.strip() and names)
    verdict = "yes" if before and complete else "partly" if before else "no"
    question = plan.question.strip() or "no question was written down"
    comparisons = (
        "; ".join(f"compares {first} and {second}" for first, second in names) or "names no comparison"
    )
    return Item(
        "Question and comparison before the first trial",
        verdict,
        f"“{question}”; {comparisons}; frozen {plan.frozen_at:%Y-%m-%d %H:%M} UTC",
    )


def _criteria(plan: Plan) -> Item:
    scenes = (plan.document or {})["scenes"]
    written = sum(bool(scene["criterion"].strip()) for scene in scenes)
    stones = sum(bool(scene["milestones"]) for scene in scenes)
    verdict = "yes" if written == stones == len(scenes) else "partly" if written or stones else "no"
    return Item(
        "Criteria of success and milestones written down",
        verdict,
        f"{written} of {len(scenes)} scenes have a criterion, {stones} have milestones",
    )


def _order(plan: Plan) -> Item:
    order = (
        "blocks of one initial condition with every checkpoint"
        if plan.allocation == Allocation.PAIRED
        else f"two checkpoints by a fair coin, at each initial condition at most {IMBALANCE} trials apart"
    )
    return Item(
        "Randomised, interleaved, balanced",
        "yes",
        f"{order}; commitment {plan.commitment[:16]}…"
        + (", verified at the reveal" if plan.revealed_at else ", not yet revealed"),
    )


def _blind(plan: Plan) -> Item:
    if not plan.blind:
        return Item("Operators blind", "no", "the plan was open")
    looked = [
        row["by_name"] + ("" if row["own"] else f" (at {row['name']} v{row['version']})")
        for row in looked_behind(plan)
    ]
    text = (
        f"looked before the reveal: {', '.join(looked)}; they ran no trial from then on, "
        "but they could still stand by or press an e-stop"
        if looked
        else "no looks before the reveal"
    )
    return Item("Operators blind", "partly" if looked else "yes", f"a fresh code for every trial; {text}")


def _complete(result: PlanResult, trials) -> Item:  # type: ignore[no-untyped-def]
    plan = result.plan
    foreseen, counted = plan.slots.count(), trials.filter(status=TrialStatus.SCORED).count()
    rule = plan.get_stopping_display()
    ended = result.design is not None and findings(result.design, result.blocks).ended
    verdict = "yes" if counted == foreseen or ended else "partly"
    closed = f"; closed because: {plan.closed_because}" if plan.closed_because else ""
    return Item(
        "As many trials as planned, or a rule to stop",
        verdict,
        f"{counted} of {foreseen} count; {rule}{closed}",
    )


def _voids(plan: Plan, trials) -> Item:  # type: ignore[no-untyped-def]
    voided = trials.filter(status=TrialStatus.VOIDED)
    late = voided.filter(voided_at__gte=plan.stored_at).count() if plan.stored_at else 0
    text = f"{voided.count()} voided in this version, each with a reason, {late} of them after the reveal"
    return Item("No trial of this version voided after the reveal", _yes_or_no(late == 0), text)


def _corrections(plan: Plan) -> Item:
    scores = Score.objects.filter(trial__evaluation=plan.evaluation_id)
    rows = with_changes(scores, why=F("reason"), at=F("scored_at"))
    corrected = sum(bool(row["why"]) for row in rows if row["changed"] == VERDICT)
    late = Counter(row["changed"] for row in rows if plan.stored_at and row["at"] > plan.stored_at)
    categories = sum(row["changed"] == CATEGORY for row in rows)
    text = (
        f"{corrected} corrections, each a row of its own with author and reason, {late[VERDICT]} scores after the "
        "reveal"
    )
    if categories:
        text += f"; failure categories alone corrected {categories} times, {late[CATEGORY]} of them after the reveal"
    verdict = "no" if late[VERDICT] else "partly" if corrected else "yes"
    return Item("Scores kept as they were given", verdict, text)


def _versions(plan: Plan) -> Item:
    before, left, version = 0, 0, plan.amends
    while version is not None:
        before, left = before + bool(version.document), left + needed_handouts(version).count()
        version = version.amends
    text = f"version {plan.version}; {before} frozen before it"
    if before:
        text += f", each with all of its alpha; their {left} attempts are not in these data"
    return Item("One version of the plan", _yes_or_no(before == 0), text)


def _second_rater(plan: Plan, trials) -> Item:  # type: ignore[no-untyped-def]
    rated = (
        Rating.objects.filter(trial__evaluation=plan.evaluation_id, blind=True)
        .values("trial")
        .distinct()
        .count()
    )
    n = trials.filter(status=TrialStatus.SCORED).count()
    target = round(plan.second_rater_share * n)
    verdict = "yes" if rated and rated >= target else "partly" if rated else "no"
    return Item(
        "A second, blind rater", verdict, f"{rated} of {n} trials were rated again; planned were {target}"
    )


def _narrative(analysis: Analysis) -> Item:
    failed = sum(arm.success.n - arm.success.successes for arm in analysis.arms)
    named = sum(m.count for arm in analysis.arms for m in arm.failures if m.phase or m.cause)
    verdict = "yes" if named == failed else "partly" if named else "no"
    return Item("Why trials failed", verdict, f"{named} of {failed} failures have a reason")


def _recorded(trials) -> Item:  # type: ignore[no-untyped-def]
    counted = trials.filter(status=TrialStatus.SCORED)
    n, recorded = counted.count(), counted.filter(episode__isnull=False).count()
    verdict = "yes" if recorded == n else "partly" if recorded else "no"
    return Item("Every trial that counts recorded", verdict, f"{recorded} of {n} have a recording")


def _configurations(trials) -> Item:  # type: ignore[no-untyped-def]
    rows = (
        trials.filter(status=TrialStatus.SCORED, episode__isnull=False)
        .values("checkpoint", "station")
        .annotate(n=Count("episode__configuration_hash", distinct=True))
    )
    changed = [row for row in rows if row["n"] > 1]
    if not rows:
        return Item("One configuration throughout", "no", "no recording says which it was")
    text = f"{len(changed)} of {len(rows)} combinations of checkpoint and station had more than one"
    return Item("One configuration throughout", "yes" if not changed else "partly", text)


def _spread(trials) -> Item:  # type: ignore[no-untyped-def]
    counted = trials.filter(status=TrialStatus.SCORED).aggregate(
        conditions=Count("position", distinct=True),
        stations=Count("station", distinct=True),
        operators=Count("operator", distinct=True),
        days=Count(F("started_at__date"), distinct=True),
    )
    text = "{conditions} initial conditions, {stations} stations, {operators} operators, {days} days".format(
        **counted
    )
    return Item("Tried under different conditions", _yes_or_no(counted["conditions"] > 1), text)
