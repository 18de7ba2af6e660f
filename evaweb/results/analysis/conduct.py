"""Conduct of an evaluation: everything in its record that may give a reader reason for doubt.

Values are numbers and texts without formatting, and times are those of the database, so that pages, REST and reports
show the same.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from statistics import median
from typing import Any

from django.contrib.admin.models import CHANGE, LogEntry
from django.db.models import Count, F, Q
from django.utils import timezone

from evaweb.core.fingerprint_cache import FingerprintCache
from evaweb.plans.bench_checks import HOLDS
from evaweb.plans.counting import end_of
from evaweb.plans.design import Names, compared
from evaweb.plans.models import Achieved, CameraCheck, Plan
from evaweb.plans.models import Look as Behind
from evaweb.plans.selectors import needed_handouts, overlapping_plans
from evaweb.results.analysis.drift import anchors_of
from evaweb.results.analysis.integrity import checkpoint_changes, with_changes
from evaweb.statistics.multiple_comparisons import holm
from evaweb.statistics.permutation import sign_flip_test
from evaweb.trials.endings import ESTOP, INTERRUPTION
from evaweb.trials.models import Scene, Score, TrialStatus, VoidRequest

DELAYS = {
    "wait": "from hand-out to run",
    "connect": "set-up: connecting to the policy",
    "warm_up": "set-up: warming up the policy",
    "latency": "policy's latency, median of the run",
    "gap": "since the trial before at the station",
}
"""Delays that are compared between the checkpoints [s]."""
_DAY = timedelta(days=1)
_delays: FingerprintCache[list[dict[str, Any]]] = FingerprintCache()


@dataclass(frozen=True, slots=True)
class AttemptRecord:
    """One attempt of a plan. All delays are in s, and None if unknown.

    `match` is the smallest agreement of a camera's image with its reference at the last bench check before the run;
    `override` is the reason for which a low match was accepted. `worker` is the copy of a simulated station that ran
    it, None for a trial of a person: nobody checks cameras of a copy, and copies run at the same time. `benchmark` is
    True if the bench waited for the policy and got its rows as they were.
    """

    number: int
    code: str
    slot: int
    block: int
    handed_at: datetime
    trial: int
    checkpoint: str
    status: str
    attempt: int
    operator: str
    station: str
    started_at: datetime | None
    ended_at: datetime | None
    reason: str
    voided_at: datetime | None
    voided_by: str | None
    match: float | None
    override: str
    connect: float | None
    warm_up: float | None
    latency: float | None
    worker: str | None = None
    benchmark: bool = False
    ended: str = ""

    @property
    def counts(self) -> bool:
        """Whether its score counts."""
        return self.status == TrialStatus.SCORED

    @property
    def machine(self) -> str:
        """Machine that ran a copy of a simulated station, and its kind: "" for a trial of a person."""
        return (self.worker or "").partition(" ")[2]

    @property
    def wait(self) -> float | None:
        """Time from allocation to run [s]."""
        return _seconds(self.handed_at, self.started_at)


def plan_conduct(plan: Plan, runs: Sequence[AttemptRecord], looks: Iterable[BenchImage]) -> dict[str, Any]:
    """Return the conduct of a plan as a dict.

    Its keys are the subjects of this module, such as `looks`, `corrections` and `deviations`; its values are the
    results of the functions below. `runs` are all attempts, `looks` all camera checks of the bench before them. One
    more query is made for each earlier version of the plan.
    """
    given_back = plan.events.filter(what="given back").order_by("pk")
    return {
        "looks": looked_behind(plan),
        "beside": [
            {"plan": row.name, "version": row.version, "state": row.state, "trials": row.trials}
            for row in overlapping_plans(plan).annotate(trials=Count("handouts", distinct=True))
        ],
        "checkpoints": _checkpoints(plan, runs),
        "voids": _voids(plan, runs),
        "broken_off": _broken_off(runs),
        "corrections": _corrections(plan, runs),
        "amendments": _amendments(plan),
        "edits": _edits(plan),
        "deviations": _deviations(runs, list(given_back.values("at", "text", by_name=F("by__username")))),
        "operators": balance(runs, "operator"),
        "stations": balance(runs, "station"),
        "benchmark": [sum(run.benchmark for run in runs if run.counts), sum(run.counts for run in runs)],
        "machines": balance([run for run in runs if run.worker], "machine"),
        "cameras": _cameras(plan, runs),
        "bench": _bench(plan, runs, looks),
        "delays": _compared(plan, runs),
        "anchors": anchors_of(plan),
    }


def looked_behind(plan: Plan) -> list[dict[str, Any]]:
    """Return the recorded unblindings of the plan, its earlier versions and related plans, in order of time.

    Unblindings after the end of the plan are left out. In each row, key `own` is True if exactly this version was
    unblinded, and key `before` is True if the unblinding preceded the freeze of this plan.
    """
    of_the_same = Q(plan__name=plan.name, plan__version__lte=plan.version) | Q(
        plan__in=overlapping_plans(plan)
    )
    rows = Behind.objects.filter(of_the_same).order_by("at", "pk")
    named = {"by_name": F("user__username"), "name": F("plan__name"), "version": F("plan__version")}
    return [
        {**row, "own": (row["name"], row["version"]) == (plan.name, plan.version)}
        | {"before": plan.frozen_at is not None and row["at"] < plan.frozen_at}
        for row in rows.values("at", **named)
        if plan.stored_at is None or row["at"] <= plan.stored_at
    ]


def all_attempts(plan: Plan, looks: Iterable[BenchImage]) -> list[AttemptRecord]:
    """Return every attempt in the order of allocation; one query.

    Bench matches and overrides of the attempts are taken from `looks`, the camera checks of the bench.
    """
    fields = (
        "number",
        "code",
        "slot__index",
        "slot__block",
        "handed_at",
        "trial_id",
        "slot__checkpoint__name",
    )
    own = ("status", "attempt", "operator__username", "station__name", "started_at", "ended_at")
    voided = ("reason", "voided_at", "voided_by__username")
    rows, accepted = needed_handouts(plan).order_by("number"), _accepted(looks)
    delays_of = ("trial__setup_took", "trial__episode__policy")
    end_fields = (
        *delays_of,
        "trial__ended_by",
        "trial__episode__status",
        "trial__worker",
        "trial__truth__benchmark",
    )
    attempts = []
    named = [f"trial__{name}" for name in (*own, *voided)]
    for row in rows.values_list(*fields, *named, *end_fields):
        *plain, took, policy, stored_end, recording, worker, benchmark = row
        latency = _number(policy, "latency_ms", "p50")
        delays = (_number(took, "connect_s"), _number(took, "warm_up_s"), latency and latency / 1000)
        match = accepted.get(row[fields.index("trial_id")], (None, ""))
        attempt = AttemptRecord(*plain, *match, *delays, worker, bool(benchmark))
        told_now = attempt.status == TrialStatus.VOIDED and stored_end is None  # its reason is a person's
        attempts.append(
            attempt
            if told_now
            else replace(attempt, ended=end_of(stored_end, attempt.status, attempt.reason or "", recording))
        )
    return attempts


@dataclass(frozen=True, slots=True)
class BenchImage:
    """Check of one camera's image of the bench before a run.

    `match` is its agreement with the reference, None without one; `override` is the reason for which a low match was
    accepted. If the reference has regions, their matches count instead of the whole image's: the match gate uses them.
    """

    trial: int
    place: tuple[str, str, int, str]
    reference: int | None
    match: float | None
    override: str

    @property
    def camera(self) -> str:
        """Name of the camera."""
        return self.place[-1]


def bench_images(plan: Plan) -> list[BenchImage]:
    """Return the camera checks of the bench before the plan's runs, in the order in which they were made; one query."""
    rows = Achieved.objects.filter(trial__handout__plan=plan).order_by("pk")
    place = ("trial__station__name", "trial__scene__name", "trial__position__number", "camera")
    return [
        BenchImage(
            trial,
            (station, scene, position, camera),
            reference,
            min((region["match"] for region in regions), default=match),
            override,
        )
        for trial, station, scene, position, camera, reference, match, regions, override in rows.values_list(
            "trial_id", *place, "reference_id", "match", "regions", "override"
        )
    ]


def _accepted(images: Iterable[BenchImage]) -> dict[int, tuple[float | None, str]]:
    """Return by trial the smallest match of its last bench check, and the reason for which a low match was accepted."""
    newest: dict[int, dict[str, BenchImage]] = defaultdict(dict)
    for image in images:
        newest[image.trial][image.camera] = image
    return {
        trial: (
            min((image.match for image in cameras.values() if image.match is not None), default=None),
            next((image.override for image in cameras.values() if image.override), ""),
        )
        for trial, cameras in newest.items()
    }


def balance(runs: Iterable[AttemptRecord], name: str) -> dict[str, Any]:
    """Return the number of trials that count, by operator, station or machine and by checkpoint.

    `name` is "operator", "station" or "machine". Key `uneven` of the result is the largest number of trials by which
    one of these differs from a proportional share of a checkpoint's trials. Dropped checkpoints and random order alone
    do not increase it.
    """
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    counted = [run for run in runs if run.counts]
    names = sorted({run.checkpoint for run in counted})
    for run in counted:
        counts[getattr(run, name)][run.checkpoint] += 1
    trials = {group: [of[checkpoint] for checkpoint in names] for group, of in sorted(counts.items())}
    of_all = [sum(numbers) for numbers in zip(*trials.values(), strict=True)]
    off = [
        abs(count - sum(numbers) * all_ / len(counted))
        for numbers in trials.values()
        for count, all_ in zip(numbers, of_all, strict=True)
    ]
    uneven = round(max(off, default=0.0), 1)
    rows = [{"name": group, "trials": numbers} for group, numbers in trials.items()]
    return {"checkpoints": names, "rows": rows, "uneven": uneven}


def _checkpoints(plan: Plan, runs: Sequence[AttemptRecord]) -> list[dict[str, Any]]:
    begun, repeats = set[int](), Counter[str]()
    for run in runs:  # an attempt that was not needed has a number, and is none of these
        repeats[run.checkpoint] += run.slot in begun
        begun.add(run.slot)
    return [
        {
            **asdict(row),
            "voided": row.voided,
            "repeated": repeats[row.checkpoint],
            "operators": sorted(row.operators),
            "stations": sorted(row.stations),
        }
        for row in checkpoint_changes(plan)
    ]


def _voids(plan: Plan, runs: Sequence[AttemptRecord]) -> list[dict[str, Any]]:
    """Return every void with its outcome: requested voids first, then voids that needed only one operator."""
    by_trial = {run.trial: run for run in runs}
    requests = VoidRequest.objects.filter(trial__handout__plan=plan).order_by("pk")
    fields = ("trial_id", "reason", "at", "answer", "answer_reason", "answered_at")
    rows = [
        {**row, "answer": row["answer"] or "not answered"}
        for row in requests.values(
            *fields, by_name=F("by__username"), answered_by_name=F("answered_by__username")
        )
    ]
    granted = {row["trial_id"] for row in rows if row["answer"] == VoidRequest.Answer.AGREED}
    rows += [
        {
            "trial_id": run.trial,
            "reason": run.reason,
            "at": run.voided_at,
            "by_name": run.voided_by,
            "answer": "",
        }
        | {"answer_reason": "", "answered_at": None, "answered_by_name": None}
        for run in runs
        if run.status == TrialStatus.VOIDED and run.trial not in granted
    ]
    return [
        {**row, "code": by_trial[row["trial_id"]].code, "checkpoint": by_trial[row["trial_id"]].checkpoint}
        for row in rows
    ]


def _broken_off(runs: Sequence[AttemptRecord]) -> list[dict[str, Any]]:
    """Return the attempts that were ended by e-stop or interruption, or never ran, with the reason."""
    return [
        {
            "trial_id": run.trial,
            "code": run.code,
            "checkpoint": run.checkpoint,
            "by_name": run.operator,
            "at": run.ended_at or run.handed_at,
            "ran": run.status != TrialStatus.ABANDONED,
            "ended": run.ended,
            "counts": run.counts,
            "reason": run.reason,
        }
        for run in runs
        if run.status in (TrialStatus.INTERRUPTED, TrialStatus.ABANDONED)
        or run.ended in (ESTOP, INTERRUPTION)
    ]


def _corrections(plan: Plan, runs: Sequence[AttemptRecord]) -> list[dict[str, Any]]:
    """Return every correction of a score, and every first score given after the reveal.

    In each dict, key `late` is True for scores after the reveal. Key `changed` is "verdict" or, if the verdict is
    unchanged, "category" (of a failure) or "note".
    """
    by_trial, corrections = {run.trial: run for run in runs}, []
    scores = Score.objects.filter(trial__handout__plan=plan)
    for row in with_changes(scores, why=F("reason"), at=F("scored_at"), by_name=F("rater__username")):
        earlier, run = row["earlier"], by_trial[row["trial_id"]]
        late = bool(plan.stored_at and row["at"] > plan.stored_at)
        if earlier is None and not late:
            continue
        values = {name: row[name] for name in ("trial_id", "success", "score", "at", "by_name", "changed")}
        was = {"before": earlier and earlier["success"], "score_before": earlier and earlier["score"]}
        corrections.append(
            {
                **values,
                **was,
                "reason": row["why"],
                "late": late,
                "code": run.code,
                "checkpoint": run.checkpoint,
            }
        )
    return corrections


def _amendments(plan: Plan) -> list[dict[str, Any]]:
    """Return the amendments of the plan with their reasons, newest first.

    Included are the amendments that led from the plan's first version to this one, and the one that made the next
    version, if there is one.
    """
    amendments, version = [], plan
    while version.amends is not None:
        amendments.append(
            {"version": version.version, "amends": version.amends.version, "because": version.amended_because}
        )
        version = version.amends
    later = Plan.objects.filter(amends=plan).first()
    if later is not None:
        amendments.insert(
            0, {"version": later.version, "amends": plan.version, "because": later.amended_because}
        )
    return amendments


def _edits(plan: Plan) -> list[dict[str, Any]]:
    """Return changes of the plan's scenes and checkpoints between freezing and reveal, including reverted ones.

    The source is the log of the administration and the scene editor.
    """
    if plan.frozen_at is None:
        return []
    rows = LogEntry.objects.filter(
        content_type__app_label="trials",
        content_type__model__in=("scene", "checkpoint"),
        action_flag=CHANGE,
        action_time__gte=plan.frozen_at,
        action_time__lte=plan.stored_at or timezone.now(),
    )
    entries = list(rows.select_related("user", "content_type").order_by("action_time"))
    if not entries:
        return []
    scenes = Scene.objects.filter(positions__plan=plan).distinct()
    called = {("scene", str(pk)): name for pk, name in scenes.values_list("pk", "name")}
    called |= {("checkpoint", str(pk)): name for pk, name in plan.checkpoints.values_list("pk", "name")}
    return [
        {
            "what": f"{row.content_type.model} {name}",
            "at": row.action_time,
            "by_name": row.user.get_username(),
            "text": row.get_change_message(),
        }
        for row in entries
        if (name := called.get((row.content_type.model, row.object_id)))
    ]


def _deviations(runs: Sequence[AttemptRecord], given_back: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return deviations from the schedule.

    Included are blocks split between stations or operators, trials out of order, time spans of blocks, and the slots
    that stations gave back (`given_back`).
    """
    blocks: dict[int, list[AttemptRecord]] = defaultdict(list)
    for run in runs:
        if run.status != TrialStatus.ABANDONED:
            blocks[run.block].append(run)
    spans = {block: span for block, rows in blocks.items() if (span := _span(rows)) is not None}
    longest = max(spans, key=lambda block: spans[block], default=None)
    return {
        "blocks": len(blocks),
        "split_stations": [b for b, rows in sorted(blocks.items()) if len({run.station for run in rows}) > 1],
        "split_operators": [
            b for b, rows in sorted(blocks.items()) if len({run.operator for run in rows}) > 1
        ],
        "order": [block for block, rows in sorted(blocks.items()) if _is_out_of_order(rows)],
        "out_of_turn": _out_of_order_codes(runs),
        "span_median_s": median(spans.values()) if spans else None,
        "span_longest_s": spans[longest] if longest is not None else None,
        "span_longest_block": longest,
        "over_a_day": [block for block, span in sorted(spans.items()) if span > _DAY.total_seconds()],
        "given_back": [dict(row) for row in given_back],
    }


def _span(rows: Iterable[AttemptRecord]) -> float | None:
    """Return the time between the first and the last start of a block's trials that count [s]."""
    starts = [run.started_at for run in rows if run.counts and run.started_at is not None]
    return (max(starts) - min(starts)).total_seconds() if len(starts) > 1 else None


def _is_out_of_order(rows: Iterable[AttemptRecord]) -> bool:
    """Return True if the trials that count were not run in the drawn order; copies run several at the same time."""
    slots = [run.slot for run in rows if run.counts and not run.worker]
    return slots != sorted(slots)


def _out_of_order_codes(runs: Iterable[AttemptRecord]) -> list[str]:
    """Return the codes of first attempts that came after an attempt at a later slot at the same station."""
    reached: dict[str, int] = {}
    begun: set[int] = set()
    codes = []
    for run in runs:
        if not run.worker and run.slot not in begun and run.slot < reached.get(run.station, -1):
            codes.append(run.code)
        begun.add(run.slot)
        reached[run.station] = max(reached.get(run.station, -1), run.slot)
    return codes


def _cameras(plan: Plan, runs: Sequence[AttemptRecord]) -> dict[str, Any]:
    """Return the camera checks made at the plan's stations during its trials.

    Key `unchecked` of the result has the codes of the trials before which the same operator made no sufficiently recent
    check.
    """
    handed = [run.handed_at for run in runs]
    if not handed:
        return {"checks": [], "unchecked": []}
    rows = CameraCheck.objects.filter(
        station__name__in={run.station for run in runs}, at__gte=min(handed) - HOLDS, at__lte=max(handed)
    ).order_by("pk")
    checks = [
        {
            **{name: row[name] for name in ("at", "station_name", "by_name")},
            "cameras": len(row["seen"]),
            "match": min(
                (view["match"] for view in row["seen"].values() if view["match"] is not None), default=None
            ),
        }
        for row in rows.values("at", "seen", station_name=F("station__name"), by_name=F("by__username"))
    ]
    times: dict[tuple[str, str], list[datetime]] = defaultdict(list)
    for check in checks:
        times[check["station_name"], check["by_name"]].append(check["at"])
    unchecked = [
        run.code
        for run in runs
        if not run.worker
        and not any(run.handed_at - HOLDS <= at <= run.handed_at for at in times[run.station, run.operator])
    ]
    return {"checks": checks, "unchecked": unchecked}


def _bench(plan: Plan, runs: Iterable[AttemptRecord], images: Iterable[BenchImage]) -> dict[str, Any]:
    """Return the plan's match gate, and the runs that did not demonstrably pass the gate.

    The match gate is the least match of a camera's picture with its reference picture; None if the plan has none. In
    the result, key `gate` is the gate. Key `low` lists the runs with a match below the gate. Key `unmatched` lists the
    codes of runs without a known match. Key `references` lists the cameras whose reference image was replaced during
    the plan.
    """
    gate = (plan.document or {}).get("match_gate")
    ran = [run for run in runs if run.started_at is not None] if gate is not None else []
    references: dict[tuple[str, str, int, str], set[int]] = defaultdict(set)
    for image in images:
        if image.reference is not None:
            references[image.place].add(image.reference)
    return {
        "gate": gate,
        "low": [
            {
                "code": run.code,
                "checkpoint": run.checkpoint,
                "match": run.match,
                "override": run.override,
                "operator": run.operator,
            }
            for run in ran
            if run.match is not None and gate is not None and run.match < gate
        ],
        "unmatched": [run.code for run in ran if run.match is None],
        "references": [
            {"station": station, "scene": scene, "position": position, "camera": camera, "used": len(used)}
            for (station, scene, position, camera), used in sorted(references.items())
            if len(used) > 1
        ],
    }


# --- delays ---------------------------------------------------------------------------------------------------


def _compared(plan: Plan, runs: Sequence[AttemptRecord]) -> dict[str, Any]:
    """Return the statistics of each checkpoint's delays, such as idle time and latency.

    The checkpoints of planned comparisons are compared by paired tests with Holm's correction for the number of tests.
    """
    names = compared(plan.document or {})
    gaps = _idle_gaps(runs)
    values = tuple(
        (
            name,
            tuple(
                (run.block, run.checkpoint, gaps.get(run.number) if name == "gap" else getattr(run, name))
                for run in runs
                if run.counts
            ),
        )
        for name in DELAYS
    )
    key: Hashable = (values, tuple(names))
    rows = _delays.get(plan.pk, key, lambda: _tested(values, names))
    tests = [test for row in rows for test in row["tests"] if test["p"] is not None]
    differing = [row["what"] for row in rows if any(_differs(test, plan.alpha) for test in row["tests"])]
    return {"alpha": plan.alpha, "rows": rows, "tested": len(tests), "differing": differing}


def _differs(test: dict[str, Any], alpha: float) -> bool:
    return test["corrected"] is not None and test["corrected"] <= alpha


def _tested(
    values: Iterable[tuple[str, Sequence[tuple[int, str, float | None]]]], comparisons: Sequence[Names]
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for name, triples in values:
        measured = [(block, checkpoint, value) for block, checkpoint, value in triples if value is not None]
        if not measured:
            continue
        arms: dict[str, list[float]] = defaultdict(list)
        blocks: dict[int, dict[str, float]] = defaultdict(dict)
        for block, checkpoint, value in measured:
            arms[checkpoint].append(value)
            blocks[block][checkpoint] = value
        rows.append(
            {
                "what": DELAYS[name],
                "arms": [
                    {"checkpoint": arm, "n": len(of), "median": median(of), "longest": max(of)}
                    for arm, of in sorted(arms.items())
                ],
                "tests": [_test(names, blocks.values()) for names in comparisons],
            }
        )
    tests = [test for row in rows for test in row["tests"]]
    corrected = iter(holm([test["p"] for test in tests if test["p"] is not None]))
    for test in tests:
        test["corrected"] = None if test["p"] is None else next(corrected)
    return rows


def _test(names: Names, blocks: Iterable[dict[str, float]]) -> dict[str, Any]:
    """Return the sign-flip test of the first checkpoint's values minus the second's, over the blocks that have both."""
    first, second = names
    pairs = [values[first] - values[second] for values in blocks if first in values and second in values]
    widest = max(map(abs, pairs), default=0.0)
    test = sign_flip_test(pairs, widest) if widest else None
    return {
        "first": first,
        "second": second,
        "pairs": len(pairs),
        "difference": test.value if test else 0.0 if pairs else None,
        "p": test.p if test else 1.0 if pairs else None,
    }


def _idle_gaps(runs: Iterable[AttemptRecord]) -> dict[int, float]:
    """Return for each attempt how long its station was idle before it [s], by attempt number.

    This is the time from the end of the previous attempt at the same station to the start of the attempt.
    """
    ended: dict[str, datetime] = {}
    gaps = {}
    begun = [(run.started_at, run.number, run) for run in runs if run.started_at is not None]
    for started_at, _, run in sorted(begun, key=lambda row: row[:2]):
        gap = _seconds(ended.get(run.station), started_at)
        if gap is not None:
            gaps[run.number] = gap
        if run.ended_at is not None:
            ended[run.station] = run.ended_at
    return gaps


def _seconds(since: datetime | None, until: datetime | None) -> float | None:
    """Return the time between two instants [s]; None if one is unknown, or they are reversed (clocks differ)."""
    if since is None or until is None or until < since:
        return None
    return (until - since).total_seconds()


def _number(table: Any, *names: str) -> float | None:
    """Return a number from nested tables of a station; None if it is missing."""
    for name in names:
        table = table.get(name) if isinstance(table, dict) else None
    return float(table) if isinstance(table, (int, float)) and not isinstance(table, bool) else None
