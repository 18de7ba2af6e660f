"""Agreement of raters and automatic judges, and preference ranking, as JSON; undefined values are null."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import asdict
from typing import Any

from django.db.models import F, Q

from evaweb.plans.models import Plan
from evaweb.results.models import Judgement, Preference, Rating
from evaweb.statistics.base import StatisticsError
from evaweb.statistics.calibration import calibration
from evaweb.statistics.preference import Comparison, NotIdentifiedError, preferences
from evaweb.statistics.proportions import proportion
from evaweb.statistics.raters import cohen_kappa, gwet_ac1, krippendorff_alpha
from evaweb.trials.models import Score, TrialStatus


def rater_agreement(plan: Plan) -> dict[str, Any] | None:
    """Return the agreement of first and second raters on success and on each milestone; None without second ratings.

    Each second rating is compared with the score that was current when it was made, because later corrections may
    follow the second rating.
    """
    rows = list(
        Rating.objects.filter(trial__evaluation=plan.evaluation_id, trial__status=TrialStatus.SCORED)
        .prefetch_related("trial__scores__outcomes")
        .order_by("trial_id", "pk")
    )
    if not rows:
        return None
    verdicts = [(_score_at(row), row) for row in rows]
    return {
        "trials": len({row.trial_id for row in rows}),
        "ratings": len(rows),
        "blind": sum(row.blind for row in rows),
        "success": agreement([(first.success, second.success) for first, second in verdicts]),
        "milestones": _milestones(verdicts),
        "score_alpha": _defined(
            krippendorff_alpha, [[first.score, second.score] for first, second in verdicts], "interval"
        ),
    }


def agreement(pairs: list[tuple[bool, bool]]) -> dict[str, Any]:
    """Return the agreement of two raters on yes/no pairs: share of equal ratings, Cohen's kappa, Gwet's AC1,
    Krippendorff's alpha.
    """
    same = proportion(sum(first == second for first, second in pairs), len(pairs))
    return {
        "n": same.n,
        "same": same.successes,
        "wilson": [same.interval.low, same.interval.high] if same.interval else None,
        "kappa": _defined(cohen_kappa, pairs),
        "ac1": gwet_ac1(pairs),
        "alpha": _defined(krippendorff_alpha, [[float(first), float(second)] for first, second in pairs]),
    }


def by_text(milestones: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return a dict from each milestone's text to its value; a repeated text is numbered in order: "held (2)"."""
    by_label: dict[str, Any] = {}
    for text, value in milestones:
        label, n = text, 1
        while label in by_label:
            n += 1
            label = f"{text} ({n})"
        by_label[label] = value
    return by_label


def _score_at(rating: Rating | Judgement) -> Score:
    """Return the score that was current when the rating or judgement was made.

    If the clock was set back so that all scores seem later, it is the first score.
    """
    scores = list(rating.trial.scores.all())
    return next((score for score in reversed(scores) if score.scored_at <= rating.at), scores[0])


def _milestones(verdicts: list[tuple[Score, Rating]]) -> dict[str, Any]:
    pairs: dict[str, list[tuple[bool, bool]]] = {}
    for verdict, rating in verdicts:
        reached_again = by_text((text, bool(reached)) for text, reached in rating.milestones)
        for text, reached in _scored(verdict).items():
            if text in reached_again:
                pairs.setdefault(text, []).append((reached, reached_again[text]))
    return {text: agreement(text_pairs) for text, text_pairs in pairs.items()}


def _scored(score: Score) -> dict[str, bool]:
    return by_text((row.text, row.reached) for row in score.outcomes.all())


def _defined(statistic: Callable[..., float], *given: Any) -> float | None:
    """Return the statistic, or None if it is undefined, for example if all ratings are equal."""
    try:
        return statistic(*given)
    except StatisticsError:
        return None


def judge_agreement(plan: Plan) -> list[dict[str, Any]] | None:
    """Return for each version of each automatic judge its agreement with the scores that were current when it judged.

    None without judgements.

    Second raters and judges are kept strictly apart: neither counts in the other's agreement.
    """
    counted = Judgement.objects.filter(
        trial__evaluation=plan.evaluation_id, trial__status=TrialStatus.SCORED
    ).prefetch_related("trial__scores__outcomes")
    rows = defaultdict(list)
    for row in counted.order_by("trial_id", "pk"):
        rows[row.judge, row.version].append(row)
    return [_judged(*key, of_one) for key, of_one in sorted(rows.items())] or None


def _judged(judge: str, version: str, rows: list[Judgement]) -> dict[str, Any]:
    verdicts: dict[str, list[tuple[bool, bool | None, float | None]]] = {}
    for row in rows:
        by_label = by_text((text, own) for text, *own in row.milestones)
        for text, reached in _scored(_score_at(row)).items():
            if text in by_label:
                verdicts.setdefault(text, []).append((reached, *by_label[text]))
    return {
        "judge": judge,
        "version": version,
        "trials": len(rows),
        "no_verdict": dict(sorted(Counter(row.reason for row in rows if row.reason).items())),
        "milestones": {text: _on_milestone(triples) for text, triples in verdicts.items()},
        "calibration": _calibration([triple for triples in verdicts.values() for triple in triples]),
    }


def _on_milestone(verdicts: list[tuple[bool, bool | None, float | None]]) -> dict[str, Any]:
    pairs = [(scored, reached) for scored, reached, _ in verdicts if reached is not None]
    calibrated = _calibration(verdicts)
    return {
        "no_verdict": len(verdicts) - len(pairs),
        "agreement": agreement(pairs) if pairs else None,
        "brier": calibrated and calibrated["brier"],
    }


def _calibration(verdicts: list[tuple[bool, bool | None, float | None]]) -> dict[str, Any] | None:
    """Return the calibration of a judge's probabilities against the scores; None if it gave no probability.

    `verdicts` has a triple per milestone: whether the score counts it as reached, the judge's verdict, its probability.
    """
    probabilities = [(probability, scored) for scored, _, probability in verdicts if probability is not None]
    return asdict(calibration(probabilities)) if probabilities else None


def preference_comparisons(plan: Plan) -> list[Comparison]:
    """Return the plan's preferences as comparisons of two checkpoints.

    All preferences about the same two trials together have weight 1. With random order, two trials of a block may have
    the same checkpoint: raters are asked about them as well, but such preferences are left out here.
    """
    same = Q(first__checkpoint=F("second__checkpoint"))
    rows = Preference.objects.filter(~same, plan=plan).order_by("pk")
    names = ("first__checkpoint__name", "second__checkpoint__name", "outcome")
    answers = list(rows.values_list("first_id", "second_id", *names))
    people = Counter((first, second) for first, second, *_ in answers)
    return [Comparison(*named, 1 / people[first, second]) for first, second, *named in answers]


def preference_ranking(plan: Plan) -> dict[str, Any] | None:
    """Return the Bradley-Terry-Davidson ranking of the plan's preferences, None without any.

    Key `ranking` of the result is null if no finite, unique ranking exists. Then key `reason` explains why, and each
    entry of `groups` can be ranked on its own.
    """
    comparisons = preference_comparisons(plan)
    if not comparisons:
        return None
    counted = {"n": len(comparisons), "ties": sum(row.outcome == "tie" for row in comparisons)}
    nothing = {"ranking": None, "contrasts": [], "tie": None, "order": None, "order_z": None, "groups": []}
    try:
        ranking = preferences(comparisons, order_effect=True)
    except StatisticsError:
        try:
            ranking = preferences(comparisons)
        except NotIdentifiedError as error:
            return {
                **counted,
                **nothing,
                "reason": str(error),
                "groups": [list(part) for part in error.components],
            }
        except StatisticsError as error:
            return {**counted, **nothing, "reason": str(error)}
    return {
        **counted,
        "ranking": [
            {
                "checkpoint": name,
                "worth": ranking.worth[name],
                "error": ranking.error[name],
                "rating": ranking.rating(name),
            }
            for name in ranking.ranking
        ],
        "contrasts": [
            {
                "first": first,
                "second": second,
                "difference": row.difference,
                "win_probability": row.win_probability,
                "interval": [row.win_interval.low, row.win_interval.high],
            }
            for (first, second), row in ranking.contrasts.items()
        ],
        "tie": ranking.tie,
        "order": ranking.order,
        "order_z": ranking.order_z,
        "groups": [],
        "reason": "",
    }
