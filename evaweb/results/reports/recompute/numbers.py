"""All numbers of a report from its trials, in the structure of the report's `numbers.json`."""

from __future__ import annotations

import math
import random
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from . import methods
from .designs import comparisons_of
from .methods import student

DRAWS = 4000


@dataclass(frozen=True)
class Trial:
    """Row of trials.csv."""

    order: int
    block: str
    slot: int
    checkpoint: str
    scene: str
    position: int
    status: str
    success: bool
    score: float
    duration: float | None
    failure: str
    milestones: tuple[tuple[str, bool], ...]
    smoothness: float | None = None
    commanded: float | None = None
    failure_phase: str = ""
    operator: str = ""
    station: str = ""

    @property
    def condition(self) -> str:
        """Initial condition."""
        return f"{self.scene}/{self.position}"


@dataclass(frozen=True)
class Drawn:
    """Newly drawn samples for checking an interval.

    The lower end of the interval is the 2.5 % quantile of `lower`, its upper end the 97.5 % quantile of `upper`.
    """

    lower: list[float]
    upper: list[float]


@dataclass(frozen=True)
class Timing:
    """Horizon of times to success, and the time limit of each scene.

    `until` [s] is the horizon; it is 0 if no trial has a known duration. `limits` maps names of scenes to time limits
    [s].
    """

    until: float
    limits: Mapping[str, float]

    def time(self, trial: Trial) -> float:
        """Return the time to success up to the horizon [s]; the horizon for a failure."""
        assert trial.duration is not None
        own = min(trial.duration, self.limits.get(trial.scene, math.inf))
        return own if self.reached(trial) else self.until

    def reached(self, trial: Trial) -> bool:
        """Return True if the trial succeeded within the horizon."""
        own = min(trial.duration or 0.0, self.limits.get(trial.scene, math.inf))
        return trial.success and own <= self.until

    def known(self, trials: Trials) -> list[Trial]:
        """Return the trials with a known time."""
        return [t for t in trials if t.duration is not None] if self.until > 0 else []


Trials = Sequence[Trial]


def numbers(trials: Trials, plan: Mapping[str, Any], said: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return every number; `said` are the conclusions of the plan's design."""
    alpha = plan["stopping"]["alpha"]
    arms: dict[str, list[Trial]] = defaultdict(list)
    broken: dict[str, list[Trial]] = defaultdict(list)
    for trial in sorted(trials, key=lambda t: t.order):
        if trial.status == "scored":
            arms[trial.checkpoint].append(trial)
        elif trial.status == "interrupted":
            broken[trial.checkpoint].append(trial)
    names = sorted(arms, key=lambda name: (-_rate(arms[name]), name))
    limits = {s["name"]: s["time_limit_s"] for s in plan["scenes"] if s["time_limit_s"] is not None}
    longest = max((t.duration or 0.0 for arm in arms.values() for t in arm), default=0.0)
    timing = Timing(min(limits.values()) if limits else longest, limits)
    planned = comparisons_of(plan)
    couples = [
        next((pair for pair in planned if set(pair) == set(couple)), couple)
        for couple in combinations(names, 2)
    ]
    in_pairs = plan.get("allocation", "paired") == "paired"
    compared = [
        _comparison(
            *(a, b, arms[a], arms[b]),
            alpha / (len(planned) if (a, b) in planned else len(couples)),
            timing,
            in_pairs,
        )
        for a, b in couples
    ]
    for comparison, p in zip(compared, methods.holm([c["barnard"]["p"] for c in compared]), strict=True):
        comparison["barnard"]["holm"] = p
    corrected = {frozenset((c["first"], c["second"])): c["barnard"]["holm"] for c in compared}
    decided = {(conclusion["first"], conclusion["second"]): conclusion for conclusion in said}
    for comparison in compared:
        conclusion = decided.get((comparison["first"], comparison["second"]))
        comparison["standing"] = (
            "not planned" if conclusion is None else "open" if conclusion["at"] is None else "decided"
        )
        if conclusion is not None:  # its design decides, and not a test
            corrected[frozenset((conclusion["first"], conclusion["second"]))] = (
                0.0 if conclusion["winner"] is not None else 1.0
            )
        if comparison["standing"] == "open":
            _describe(comparison, plan["stopping"])
    has_letters = plan["stopping"].get("margin") is None or not decided
    has_letters = has_letters and all(c["standing"] != "open" for c in compared)
    return {
        "n": sum(len(arm) for arm in arms.values()),
        "alpha": alpha,
        "letters": methods.letters(names, methods.separated(names, corrected, alpha)) if has_letters else {},
        "arms": {name: _arm(arms[name], broken[name], timing) for name in names},
        "comparisons": compared,
        "recipes": _recipes(arms, plan),
    }


def _recipes(arms: Mapping[str, Trials], plan: Mapping[str, Any]) -> dict[str, Any]:
    """Return the mean rate of each recipe with several runs; with an interval from three runs on."""
    runs: dict[str, dict[str, float]] = defaultdict(dict)
    rows = plan.get("checkpoints", ())
    weights = [row["digest"] for row in rows if row.get("digest")]
    for row in rows:
        served = (
            row.get("strategy") or weights.count(row.get("digest")) > 1
        )  # the same weights served in another way
        if row.get("recipe") and row["name"] in arms and not served:
            runs[row["recipe"]][row["name"]] = _rate(arms[row["name"]])
    by_recipe = {}
    for recipe, rates in runs.items():
        pooled = student(list(rates.values())) if len(rates) > 1 else None
        if pooled is not None:
            ends = pooled["student"] if len(rates) > 2 else None
            by_recipe[recipe] = {"rates": rates, "runs": pooled["n"], "mean": pooled["mean"], "student": ends}
    return by_recipe


def _describe(comparison: dict[str, Any], stopping: Mapping[str, Any]) -> None:
    """Remove all tests and evidence from an open comparison, so that only descriptions remain.

    `stopping` is the plan's design. If it is a test by e-values, the evidence on the outcome that the design tests
    remains too.
    """
    own = {"success": "evidence", "score": "score_evidence"}[stopping.get("outcome") or "success"]
    for name in (
        *("barnard", "probability_better", "mcnemar", "scores", "over_scenes", "evidence"),
        *("score_evidence", "anytime", "sooner"),
    ):
        if name != own or stopping["rule"] != "evidence":
            comparison[name] = None
    comparison["within"] = {}
    comparison["by_scene"]["interaction_p"] = None


def _rate(trials: Trials) -> float:
    return sum(t.success for t in trials) / len(trials)


def _counts(trials: Trials) -> tuple[int, int]:
    return sum(t.success for t in trials), len(trials)


def _proportion(x: int, n: int) -> dict[str, Any]:
    return {
        "successes": x,
        "n": n,
        "rate": x / n if n else None,
        "wilson": methods.wilson(x, n) if n else None,
    }


def _by(trials: Trials, key: Callable[[Trial], str]) -> dict[str, list[Trial]]:
    groups: dict[str, list[Trial]] = defaultdict(list)
    for trial in trials:
        groups[key(trial)].append(trial)
    return dict(sorted(groups.items()))


def _arm(trials: Trials, broken: Trials, timing: Timing) -> dict[str, Any]:
    x, n = _counts(trials)
    scenes, cells = _by(trials, lambda t: t.scene), _by(trials, lambda t: t.condition)
    timed = [(t.duration, t.success) for t in trials if t.duration is not None]
    exposure = sum(d for d, _ in timed)
    whole = exposure + sum(t.duration for t in broken if t.duration is not None)
    return {
        **_proportion(x, n),
        "clopper_pearson": methods.clopper_pearson(x, n),
        "posterior": {
            "a": x + 1,
            "b": n - x + 1,
            "interval": methods.beta_interval(x + 1, n - x + 1),
        },
        "score": _mean({"all": [t.score for t in trials]}),
        "macro": _mean({name: [float(t.success) for t in rows] for name, rows in scenes.items()}),
        "scenes": {name: _proportion(*_counts(rows)) for name, rows in scenes.items()},
        "positions": {name: _proportion(*_counts(rows)) for name, rows in cells.items()},
        "milestones": {name: _funnel(rows) for name, rows in scenes.items() if rows[0].milestones},
        "time_to_success": _time(timing.known(trials), timing) if timing.known(trials) else None,
        "successes_per_hour": _per_hour(sum(ok for _, ok in timed), exposure),
        "interruptions_per_hour": _per_hour(len(broken), whole),
        "failures": dict(Counter(t.failure for t in trials if not t.success and t.failure)),
        "failure_modes": _modes(trials),
        "smoothness": student([t.smoothness for t in trials if t.smoothness is not None]),
        "smoothness_commanded": student([t.commanded for t in trials if t.commanded is not None]),
    }


def _modes(trials: Trials) -> list[dict[str, Any]]:
    """Return failure modes by phase and cause, most frequent first; shares are of all trials."""
    n = len(trials)
    counts = Counter((t.failure_phase, t.failure) for t in trials if not t.success)
    ranked = sorted((-count, not phase, phase, not cause, cause) for (phase, cause), count in counts.items())
    return [
        {
            "failure_phase": phase,
            "failure": cause,
            "count": -count,
            "n": n,
            "clopper_pearson": methods.clopper_pearson(-count, n),
        }
        for count, _, phase, _, cause in ranked
    ]


def _mean(scenes: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    means = [math.fsum(values) / len(values) for values in scenes.values()]
    value = math.fsum(means) / len(means)
    return {"value": value, "gaffke": _drawn(list(scenes.values()), 0.0, 1.0)}


def _funnel(trials: Trials) -> list[dict[str, Any]]:
    steps = []
    for i, (label, _) in enumerate(trials[0].milestones):
        before = [t for t in trials if i == 0 or t.milestones[i - 1][1]]
        steps.append(
            {
                "label": label,
                "of_all": _proportion(sum(t.milestones[i][1] for t in trials), len(trials)),
                "of_previous": _proportion(sum(t.milestones[i][1] for t in before), len(before)),
            }
        )
    return steps


def _time(trials: Trials, timing: Timing) -> dict[str, Any]:
    """Return the curve of successes over time, and the mean up to the horizon."""
    n, ended = len(trials), sorted(timing.time(t) for t in trials if timing.reached(t))
    curve = [[t, rank / n, *methods.wilson(rank, n)] for rank, t in enumerate(ended, start=1)]
    last = {point[0]: point for point in curve}  # of points at the same time the last
    lasted = [timing.time(t) / timing.until for t in trials]
    return {
        "n": n,
        "successes": len(ended),
        "until_s": timing.until,
        "median_s": next((t for rank, t in enumerate(ended, start=1) if 2 * rank >= n), None),
        "curve": list(last.values()),
        "restricted_mean": {
            "value_s": math.fsum(lasted) / n * timing.until,
            "gaffke": _drawn([lasted], 0.0, timing.until),
            "until_s": timing.until,
        },
    }


def _drawn(strata: Sequence[Sequence[float]], low: float, high: float) -> Drawn:
    """Return new draws of the mean over `strata` of outcomes from 0 to 1, scaled to [low, high].

    In each draw the outcomes of a stratum get random weights, which are gaps between sorted uniform numbers. There is
    one more gap than outcomes: its weight goes to the value 0 for the lower end, to 1 for the upper end.
    """
    chance, drawn = random.Random(1), Drawn([], [])
    counted = [list(Counter(values).items()) for values in strata]
    for _ in range(DRAWS):
        lower = upper = 0.0
        for levels in counted:
            weights = [chance.gammavariate(count, 1.0) for _, count in levels]
            more = chance.expovariate(1.0)
            total = math.fsum(weights) + more
            share = sum(weight * level for weight, (level, _) in zip(weights, levels, strict=True)) / total
            lower, upper = lower + share, upper + share + more / total
        drawn.lower.append(low + (high - low) * lower / len(strata))
        drawn.upper.append(low + (high - low) * upper / len(strata))
    return drawn


def _per_hour(events: int, exposure: float) -> dict[str, Any] | None:
    if exposure <= 0:
        return None
    hours = exposure / 3600
    return {
        "events": events,
        "exposure_s": exposure,
        "per_hour": events / hours,
        "garwood": [end / hours for end in methods.garwood(events)],
    }


def _comparison(
    first_name: str,
    second_name: str,
    first: Trials,
    second: Trials,
    alpha: float,
    timing: Timing,
    in_pairs: bool,
) -> dict[str, Any]:
    counts = (*_counts(first), *_counts(second))
    pairs = _pairs(first, second) if in_pairs else []
    consecutive = [
        pair for place, pair in enumerate(pairs) if int(pair[0].block) == place
    ]  # up to the first incomplete block
    statistic, p = methods.barnard(*counts)
    only = (
        sum(a.success and not b.success for a, b in pairs),
        sum(b.success and not a.success for a, b in pairs),
    )
    return {
        "first": first_name,
        "second": second_name,
        "difference": {"value": _rate(first) - _rate(second), "newcombe": methods.newcombe(*counts)},
        "barnard": {"statistic": statistic, "p": p},
        "probability_better": methods.better(*counts),
        "pairs": len(pairs),
        "mcnemar": {
            "first_only": only[0],
            "second_only": only[1],
            "pairs": len(pairs),
            "p": methods.mcnemar(*only),
        }
        if pairs
        else None,
        "scores": _scores([a.score - b.score for a, b in pairs]) if pairs else None,
        "over_conditions": _clustered(first, second),
        "over_scenes": _stratified(first, second),
        "within": _within(first, second),
        "by_scene": _by_scene(first, second),
        "evidence": _evidence(
            methods.success_bets([(b.success, a.success) for a, b in consecutive]),
            methods.success_bets([(a.success, b.success) for a, b in consecutive]),
            alpha,
        ),
        "score_evidence": _evidence(
            methods.score_bets([a.score - b.score for a, b in consecutive]),
            methods.score_bets([b.score - a.score for a, b in consecutive]),
            alpha,
        ),
        "anytime": {
            "level": 1 - alpha,
            "success": methods.anytime([a.success - b.success for a, b in consecutive], alpha),
            "score": methods.anytime([a.score - b.score for a, b in consecutive], alpha),
        },
        "sooner": _sooner(pairs, timing),
    }


def _scores(differences: Sequence[float]) -> dict[str, Any]:
    value = math.fsum(differences) / len(differences)
    return {"pairs": len(differences), "value": value, "p": methods.sign_flips(differences)}


def _pairs(first: Trials, second: Trials) -> list[tuple[Trial, Trial]]:
    first_by_block, second_by_block = {t.block: t for t in first}, {t.block: t for t in second}
    pairs = [
        (first_by_block[block], second_by_block[block])
        for block in first_by_block
        if block in second_by_block
    ]
    return sorted(pairs, key=lambda pair: int(pair[0].block))


def _clustered(first: Trials, second: Trials) -> dict[str, Any] | None:
    first_by_condition, second_by_condition = (_by(arm, lambda t: t.condition) for arm in (first, second))
    differences = [
        _rate(first_by_condition[key]) - _rate(second_by_condition[key])
        for key in first_by_condition
        if key in second_by_condition
    ]
    if len(differences) < 2:
        return None
    drawn = _drawn([[(d + 1) / 2 for d in differences]], -1.0, 1.0)
    return {"value": math.fsum(differences) / len(differences), "gaffke": drawn}


def _stratified(first: Trials, second: Trials) -> dict[str, Any] | None:
    first_by_scene, second_by_scene = (_by(arm, lambda t: t.scene) for arm in (first, second))
    shared = [key for key in first_by_scene if key in second_by_scene]
    if len({*first_by_scene, *second_by_scene}) < 2 or not shared:
        return None
    return methods.mantel_haenszel(
        [(*_counts(first_by_scene[key]), *_counts(second_by_scene[key])) for key in shared]
    )


def _tables(first: Trials, second: Trials, key: str) -> dict[str, tuple[int, int, int, int]]:
    """Return (successes, trials, successes, trials) of both checkpoints for each stratum in which both were tried.

    `key` names the field of a trial that is its stratum.
    """
    first_groups, second_groups = ({getattr(t, key): [] for t in arm} for arm in (first, second))
    for arm, groups in ((first, first_groups), (second, second_groups)):
        for trial in arm:
            groups[getattr(trial, key)].append(trial)
    return {
        name: (*_counts(first_groups[name]), *_counts(second_groups[name]))
        for name in sorted(first_groups.keys() & second_groups.keys())
    }


def _within(first: Trials, second: Trials) -> dict[str, Any]:
    tests = {}
    for key in ("condition", "scene", "operator", "station"):
        tables = _tables(first, second, key)
        p = methods.exact_within(list(tables.values()))
        if p is not None:
            tests[key] = {"p": p, "strata": len(tables)}
    return tests


def _by_scene(first: Trials, second: Trials) -> dict[str, Any]:
    tables = _tables(first, second, "scene")
    if len(tables) < 2:
        return {"differences": {}, "interaction_p": None}
    differences = {
        name: {"value": x1 / n1 - x2 / n2, "newcombe": methods.newcombe(x1, n1, x2, n2)}
        for name, (x1, n1, x2, n2) in tables.items()
    }
    return {"differences": differences, "interaction_p": methods.interaction(list(tables.values()))}


def _sooner(pairs: Sequence[tuple[Trial, Trial]], timing: Timing) -> dict[str, Any] | None:
    timed = [pair for pair in pairs if len(timing.known(pair)) == 2]
    if not timed:
        return None
    gains = [timing.time(a) - timing.time(b) for a, b in timed]
    p = methods.sign_flips(gains, timing.until)
    return {"pairs": len(gains), "value_s": math.fsum(gains) / len(gains), "p": p}


def _evidence(first: list[float], second: list[float], alpha: float) -> dict[str, Any]:
    p = [min(1.0, math.exp(-max(path, default=0.0))) for path in (first, second)]
    bound = -math.log(alpha / 2)
    stops = [next((i for i, e in enumerate(path, 1) if e >= bound), None) for path in (first, second)]
    reached = [stop for stop in stops if stop is not None]
    stop = min(reached, default=None)
    return {
        "pairs": len(first),
        "log_e_first": first,
        "log_e_second": second,
        "p_first": p[0],
        "p_second": p[1],
        "stop": stop,
        "winner": None if stop is None else ("first" if stops[0] == stop else "second"),
    }
