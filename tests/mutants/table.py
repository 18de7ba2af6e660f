"""Seeded mistakes, each with the tests that are to notice it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

AREAS = ("timeline", "safety", "leases", "blinding", "journal", "statistics")


@dataclass(frozen=True, slots=True)
class Mutant:
    """One mistake: `new` stands in the file `path` instead of `old`, and a test in `tests` has to fail.

    `name` is AREA/MISTAKE; paths are those in the tree; `old` occurs in its file exactly once.
    """

    name: str
    path: str
    old: str
    new: str
    tests: tuple[str, ...]


def misfit(mutant: Mutant, root: Path) -> str:
    """Why a mutant does not fit the tree at `root`, "" where it does."""
    file = root / mutant.path
    if not file.is_file():
        return f"{mutant.name}: there is no {mutant.path}"
    found = file.read_text("utf-8").count(mutant.old)
    if found != 1:
        return f"{mutant.name}: its text occurs {found} times in {mutant.path}; allowed: once"
    missing = [each for each in mutant.tests if not (root / each).is_file()]
    return f"{mutant.name}: there is no {', '.join(missing)}" if missing else ""


_TIMELINE = "runtime/motion/timeline.py"
_FILTER = "runtime/safety/filter.py"
_LEASE = "runtime/processes/coordinator/lease.py"
_LEASES = "evaweb/stations/leases.py"
_JOURNAL = "evaweb/records/journal.py"
_DURABLE = "runtime/core/durable_files.py"

_OF_TIMELINE = ("tests/runtime/motion/test_timeline.py",)
_OF_STRATEGIES = ("tests/runtime/strategies/test_base.py",)
_OF_FILTER = ("tests/runtime/safety/test_filter.py",)
_OF_LEASE = ("tests/runtime/processes/coordinator/test_lease.py",)
_OF_LEASES = ("tests/evaweb/stations/test_leases.py",)
_OF_REDACTION = ("tests/evaweb/stations/test_redaction.py",)
_OF_PLANS = ("tests/evaweb/plans/test_services.py",)
_OF_JOURNAL = ("tests/evaweb/records/test_journal.py",)
_OF_SCORES = ("tests/evaweb/trials/test_services.py",)

MUTANTS = (
    # --- where the robot is sent ---------------------------------------------------------------------------
    Mutant(
        "timeline/the-longer-way-round",
        _TIMELINE,
        "apart[..., turning] -= _TURN * np.round(",
        "apart[..., turning] += _TURN * np.round(",
        _OF_TIMELINE,
    ),
    Mutant(
        "timeline/blend-that-never-ends",
        _TIMELINE,
        "linear = 1.0 - np.arange(count) / (count - 1)",
        "linear = 1.0 - np.arange(count) / count",
        _OF_TIMELINE,
    ),
    Mutant(
        "timeline/gripper-that-fades",
        _TIMELINE,
        "        action[switched] = plan.action[switched]\n",
        "",
        _OF_STRATEGIES,
    ),
    Mutant(
        "timeline/fade-counted-from-0",
        _TIMELINE,
        "max(0, self.fade.first + len(self.fade.rows) - step)",
        "max(0, len(self.fade.rows) - step)",
        _OF_STRATEGIES,
    ),
    Mutant(
        "timeline/chunk-of-the-past",
        "runtime/strategies/placement.py",
        "if due >= count:",
        "if due > count:",
        ("tests/runtime/strategies/test_placement.py",),
    ),
    Mutant(
        "timeline/newest-weighs-most",
        "runtime/strategies/ensemble.py",
        "np.exp(-self._m * np.arange(len(chunks)))",
        "np.exp(self._m * np.arange(len(chunks)))",
        ("tests/runtime/strategies/test_ensemble.py",),
    ),
    Mutant(
        "timeline/gripper-is-a-seam",
        "runtime/strategies/rtc.py",
        "        apart[list(self._dims.switched)] = 0.0\n",
        "",
        ("tests/runtime/strategies/test_rtc.py",),
    ),
    # --- what it must not be sent --------------------------------------------------------------------------
    Mutant(
        "safety/picture-that-never-came",
        _FILTER,
        "if not age <= allowed:",
        "if age > allowed:",
        _OF_FILTER,
    ),
    Mutant(
        "safety/one-joint-comes-back-for-all",
        _FILTER,
        "np.where(returning | (error <= allowed), 0.0, error)",
        "np.where(returning.any() | (error <= allowed), 0.0, error)",
        _OF_FILTER,
    ),
    Mutant(
        "safety/room-to-the-other-limit",
        _FILTER,
        "fastest = np.minimum(most[0], now + gain)",
        "fastest = np.minimum(most[1], now + gain)",
        _OF_FILTER,
    ),
    Mutant(
        "safety/arrives-too-fast",
        _FILTER,
        "own = (action - aim) / dt",
        "own = (action - state.previous) / dt",
        _OF_FILTER,
    ),
    Mutant(
        "safety/jumps-back-into-limits",
        "runtime/safety/limiter.py",
        "np.clip(moved, np.minimum(lower, previous), np.maximum(upper, previous))",
        "np.clip(moved, lower, upper)",
        ("tests/runtime/safety/test_limiter.py",),
    ),
    Mutant(
        "safety/gripper-that-cannot-open",
        "runtime/safety/collision.py",
        "self._clearance.distances(self._gripping(before, q))",
        "self._clearance.distances(before)",
        ("tests/runtime/safety/test_collision.py",),
    ),
    Mutant(
        "safety/box-of-another-axis",
        "runtime/safety/workspace.py",
        "np.maximum(self._lower - points, points - self._upper).max(axis=-1)",
        "np.maximum(self._lower - points, points - self._upper).max(axis=-2)",
        ("tests/runtime/safety/test_workspace.py",),
    ),
    # --- who commands it -----------------------------------------------------------------------------------
    Mutant(
        "leases/valid-at-its-end",
        _LEASE,
        "now < self._held.until",
        "now <= self._held.until",
        _OF_LEASE,
    ),
    Mutant(
        "leases/epoch-given-twice",
        _LEASE,
        "if epoch <= self._epoch:",
        "if epoch < self._epoch:",
        _OF_LEASE,
    ),
    Mutant(
        "leases/hidden-for-ever",
        _LEASE,
        "replace(self._held, until=now + self._ttl, hidden=False)",
        "replace(self._held, until=now + self._ttl)",
        _OF_LEASE,
    ),
    Mutant(
        "leases/epoch-begins-anew",
        _LEASES,
        'return 1 + max(int(lease["epoch"])',
        'return 1 + min(int(lease["epoch"])',
        _OF_LEASES,
    ),
    Mutant(
        "leases/name-that-begins-another",
        _LEASES,
        '.startswith(holder_of(user.get_username(), ""))',
        '.startswith(f"web:{user.get_username()}")',
        _OF_LEASES,
    ),
    Mutant(
        "leases/row-that-never-ends",
        _LEASES,
        "last.boot == boot and last.epoch > epoch",
        "last.boot == boot and last.epoch >= epoch",
        _OF_LEASES,
    ),
    # --- who knows which checkpoint it is ------------------------------------------------------------------
    Mutant(
        "blinding/tells-what-may-name",
        "evaweb/blinding/visibility.py",
        "if text and not _HARMLESS.fullmatch(text):",
        "if text and _HARMLESS.fullmatch(text):",
        _OF_REDACTION,
    ),
    Mutant(
        "blinding/only-what-is-hidden",
        "evaweb/blinding/visibility.py",
        'rows.exclude(**{f"{checkpoint}__in": self.checkpoints})',
        'rows.filter(**{f"{checkpoint}__in": self.checkpoints})',
        ("tests/evaweb/find/test_selectors.py",),
    ),
    Mutant(
        "blinding/closed-is-revealed",
        "evaweb/plans/blinding_rules.py",
        "state__in=(PlanState.FROZEN, PlanState.CLOSED)",
        "state__in=(PlanState.FROZEN,)",
        _OF_PLANS,
    ),
    Mutant(
        "blinding/sealed-for-who-looked",
        "evaweb/plans/blinding_rules.py",
        "return plan.sealed and not is_unblinded(plan, user)",
        "return plan.sealed and is_unblinded(plan, user)",
        _OF_PLANS,
    ),
    Mutant(
        "blinding/code-of-the-slot",
        "evaweb/plans/allocation.py",
        'blinding.draw_codes(bytes(locked.key or b""), number)[-1]',
        'blinding.draw_codes(bytes(locked.key or b""), slot.index + 1)[-1]',
        _OF_PLANS,
    ),
    Mutant(
        "blinding/as-quick-as-the-quickest",
        "evaweb/plans/setup_padding.py",
        "max(float(row.get(stage, 0.0)) for row in took)",
        "min(float(row.get(stage, 0.0)) for row in took)",
        ("tests/evaweb/plans/test_setup_padding.py",),
    ),
    Mutant(
        "blinding/reason-of-the-station",
        "evaweb/stations/redaction.py",
        '_reason(snapshot.get("reason"), reason, sight, covered)',
        'str(snapshot.get("reason") or "")',
        _OF_REDACTION,
    ),
    # --- what is on the disk -------------------------------------------------------------------------------
    Mutant(
        "journal/half-a-line-stays",
        _DURABLE,
        "        file.truncate(end)\n",
        "",
        _OF_JOURNAL,
    ),
    Mutant(
        "journal/not-on-the-disk-yet",
        _DURABLE,
        "        (sync or os.fsync)(file.fileno())\n",
        "",
        _OF_JOURNAL,
    ),
    Mutant(
        "journal/torn-line-takes-the-next",
        _DURABLE,
        'lines if file.read(1) == b"\\n" else',
        "lines if file.read(1) else",
        _OF_SCORES,
    ),
    Mutant(
        "journal/time-without-a-zone",
        _JOURNAL,
        "if moment is None or moment.tzinfo is None or not",
        "if moment is None or not",
        _OF_JOURNAL,
    ),
    Mutant(
        "journal/first-of-two-counts",
        _JOURNAL,
        "last = {line.uuid: line for line in lines}",
        "last = {line.uuid: line for line in reversed(lines)}",
        ("tests/evaweb/reviews/test_restoring.py",),
    ),
    Mutant(
        "journal/score-of-the-database-alone",
        "evaweb/trials/services.py",
        "    JUDGEMENTS.append(journal_uuid(trial), ScoreLine.written(score, milestones=milestones))\n",
        "",
        _OF_SCORES,
    ),
    # --- what it means -------------------------------------------------------------------------------------
    Mutant(
        "statistics/wilson-too-wide",
        "evaweb/statistics/proportions.py",
        "z2 / (4 * n * n)",
        "z2 / (4 * n)",
        ("tests/evaweb/statistics/test_proportions.py",),
    ),
    Mutant(
        "statistics/newcombe-of-the-wrong-end",
        "evaweb/statistics/difference.py",
        "down = math.hypot(p1 - first.low, second.high - p2)",
        "down = math.hypot(p1 - first.low, p2 - second.low)",
        ("tests/evaweb/statistics/test_two_arms.py",),
    ),
    Mutant(
        "statistics/holm-that-falls",
        "evaweb/statistics/multiple_comparisons.py",
        "highest = max(highest, min(1.0, (len(order) - rank) * probabilities[i]))",
        "highest = min(1.0, (len(order) - rank) * probabilities[i])",
        ("tests/evaweb/statistics/test_multiple_comparisons.py",),
    ),
    Mutant(
        "statistics/alpha-for-one-side",
        "evaweb/statistics/sequential.py",
        "if min(value_first, value_second) <= alpha / 2:",
        "if min(value_first, value_second) <= alpha:",
        ("tests/evaweb/statistics/test_sequential.py",),
    ),
    Mutant(
        "statistics/flips-without-the-seen",
        "evaweb/statistics/permutation.py",
        "below[: (total - observed) // 2 + 1]",
        "below[: (total - observed) // 2]",
        ("tests/evaweb/statistics/test_permutation.py",),
    ),
    Mutant(
        "statistics/pairs-as-they-began",
        "evaweb/results/analysis/outcomes.py",
        "max(pair.first.order, pair.second.order)",
        "min(pair.first.order, pair.second.order)",
        ("tests/evaweb/results/analysis/test_analysis.py",),
    ),
    Mutant(
        "statistics/voided-trials-count",
        "evaweb/results/analysis/load_outcomes.py",
        "scored = trials.filter(status=TrialStatus.SCORED)",
        "scored = trials.exclude(verdict=None)",
        ("tests/evaweb/results/analysis/test_load_outcomes.py",),
    ),
)
