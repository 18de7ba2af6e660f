"""Services for trials: prepare, score, abandon. Voiding is in the module `voids`."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any
from uuid import UUID

from django.contrib.auth.models import User
from django.db import IntegrityError, transaction
from django.db.models import Max

from evaweb.accounts.roles import Role, require_role, role_of
from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotAllowed,
    NotFound,
)
from evaweb.episodes.selectors import why_unrecorded
from evaweb.episodes.services import request_publish
from evaweb.records.journal import clean_text
from evaweb.stations.commands import parse_command_uuid
from evaweb.stations.models import Station
from evaweb.stations.selectors import lease_open
from evaweb.trials import failures, lifecycle
from evaweb.trials.lifecycle import Transition
from evaweb.trials.models import (
    Checkpoint,
    Evaluation,
    Milestone,
    MilestoneOutcome,
    Position,
    Scene,
    Score,
    Trial,
    TrialStatus,
)
from evaweb.trials.record import JUDGEMENTS, OutcomeLine, ScoreLine, journal_uuid
from evaweb.trials.scoring import (
    LONGEST_NOTE,
    ScoredOutcome,
    score_outcome,
    truth_ticks,
)
from evaweb.trials.selectors import attempts_of, trial_open
from evaweb.trials.station_events import apply_station_event
from runtime.core.sentences import Pattern

_PREPARED_AT_ONCE = Pattern(
    "trials.services.prepared_at_once",
    "others prepare trials of {checkpoint} at {scene} at the same moment: try again",
)
_SWITCHED_OFF = Pattern(
    "trials.services.switched_off",
    "{kind} {name} is switched off{why}: choose another, or ask an administrator",
)
_POSITION_OF_ANOTHER_SCENE = Pattern(
    "trials.services.position_of_another_scene",
    "position {position} is not one of scene {name}",
)
_OF_ANOTHER = Pattern(
    "trials.services.of_another",
    "trial {trial} is {operator}'s, and {user} does not have {station}; allowed: {operator}, who has {station}, "
    "and administrators",
)
_SEED = Pattern("trials.services.seed", "seed = {seed}; allowed: 0 to {highest_seed}")
_UNFINISHED = Pattern(
    "trials.services.unfinished",
    "trial {trial} of {name} is {label}: {advice}, then prepare the next one",
)
_SOURCE = Pattern("trials.services.source", "source = {source!r}; allowed: {values}")
_BENCH_SAYS_NOTHING = Pattern(
    "trials.services.bench_says_nothing",
    "source = truth: the bench of trial {trial} reported no truth; allowed: human",
)
_BENCH_SAYS_OTHERWISE = Pattern(
    "trials.services.bench_says_otherwise",
    "source = truth: {milestone!r} = {said}, the bench of trial {trial} says {truth}: say it as a person",
)
_UUID_OF_ANOTHER_SCORE = Pattern(
    "trials.services.uuid_of_another_score",
    "uuid {uuid} is that of another score (trial {trial_id}): give each its own",
)
_SAID_BEFORE = Pattern(
    "trials.services.said_before",
    "you sent just this for trial {trial} before, and it was corrected since: unless it is that message once "
    "more, give another reason, or a uuid",
)
_SCORED_ALREADY = Pattern(
    "trials.services.scored_already",
    "trial {trial} has a score already: to correct it, give a reason; both stay in the record",
)
_REPEATED_SINCE = Pattern(
    "trials.services.repeated_since",
    "trial {trial} was interrupted and has been repeated since: its repetition counts; score that one",
)
_ANOTHER_COUNTS = Pattern(
    "trials.services.another_counts",
    "trial {other} counts in place of trial {trial}: void this one with a reason",
)
_NEVER_RAN = Pattern(
    "trials.services.never_ran",
    "trial {trial} cannot be scored: {unrecorded}; what never ran is voided with a reason and repeated as "
    "a new attempt",
)
_NO_REASON = Pattern(
    "trials.services.no_reason",
    "reason is empty: {when} only with a reason that others can read",
)

__all__ = [
    "abandon_trial",
    "apply_station_event",
    "create_trial",
    "declare_failing",
    "dismiss_trial",
    "failing",
    "open_bench",
    "prepare_trial",
    "register_check",
    "register_settled",
    "run_checks",
    "score_trial",
]

HIGHEST_SEED = 2**31 - 1
Check = Callable[[str, Trial, Any], None]
_checks: list[Check] = []
_settled: list[Callable[[Trial, Any], None]] = []
_failing: list[Callable[[Trial], str]] = []
_TRIES = 5  # attempts to get a number in spite of concurrent users


def register_check(check: Check) -> None:
    """Register a check that is called before an action on a trial, with action, trial and user; it may raise EvaError.

    Actions are "prepared", "run", "scored", "voided", "void agreed" and "void answered". Whenever a score uses the
    scene's definition of success, "judged" is called with the trial locked, and "judged success" or "judged failure"
    once the outcome is known. For a correction that leaves success and milestones unchanged, "reworded" follows
    "scored".
    """
    _checks.append(check)


def register_settled(told: Callable[[Trial, Any], None]) -> None:
    """Register a function called with each trial that was scored, voided or abandoned, and the user.

    It is called in the same transaction.
    """
    _settled.append(told)


def declare_failing(rule: Callable[[Trial], str]) -> None:
    """Register a rule by which certain trials are failures whatever milestones were reached.

    The rule returns the reason for a trial, "" if the trial is not such a failure.
    """
    _failing.append(rule)


def failing(trial: Trial) -> str:
    """Return why the trial is a failure whatever milestones were reached; "" if its milestones decide."""
    return next((reason for rule in _failing if (reason := rule(trial))), "")


def run_checks(what: str, trial: Trial, user: Any) -> None:
    """Run the registered checks for action `what`."""
    for check in _checks:
        check(what, trial, user)


# --- preparing ---------------------------------------------------------------------------------------------


def prepare_trial(
    *,
    user: User,
    station: Station,
    scene: Scene,
    position: Position,
    checkpoint: Checkpoint,
    seed: int | None = None,
) -> Trial:
    """Prepare the next trial of this checkpoint at this position, outside any plan.

    The trial belongs to the station's open bench, the evaluation of trials without a plan. Trials are numbered, and
    each number may have several attempts. The trial is a new attempt of the lowest number whose newest attempt does not
    count; if there is no such number, it is the first attempt of the next number.
    Raises: Conflict, with advice, if the station has an unfinished trial.
    """
    require_role(user, Role.OPERATOR)
    _check_choice(station, scene, position, checkpoint, seed)
    for _ in range(_TRIES):
        try:
            with transaction.atomic():
                return _prepared(user, station, scene, position, checkpoint, seed)
        except IntegrityError:
            continue  # number or station was taken concurrently: evaluate both again
    raise Conflict(_PREPARED_AT_ONCE(checkpoint=checkpoint, scene=scene))


def open_bench(station: Station) -> Evaluation:
    """Return the evaluation of the station's trials outside any plan; create it if needed."""
    name = f"open bench {station.name}"
    bench, _ = Evaluation.objects.get_or_create(
        station=station, kind=Evaluation.Kind.OPEN_BENCH, defaults={"name": name}
    )
    return bench


def _check_choice(
    station: Station, scene: Scene, position: Position, checkpoint: Checkpoint, seed: int | None
) -> None:
    named = (("station", station.name, station), ("scene", scene.name, scene))
    for kind, name, chosen in (*named, ("checkpoint", checkpoint.name, checkpoint)):
        if not chosen.active:
            message = f" ({station.message})" if chosen is station and station.message else ""
            raise Conflict(_SWITCHED_OFF(kind=kind, name=name, why=message))
    if position.scene_id != scene.pk:
        raise NotFound(_POSITION_OF_ANOTHER_SCENE(position=position.pk, name=scene.name))
    if seed is not None and not 0 <= seed <= HIGHEST_SEED:
        raise EvaError(_SEED(seed=seed, highest_seed=HIGHEST_SEED))


def _prepared(
    user: User,
    station: Station,
    scene: Scene,
    position: Position,
    checkpoint: Checkpoint,
    seed: int | None,
) -> Trial:
    evaluation = open_bench(station)
    key = {
        "evaluation": evaluation,
        "evaluation_version": evaluation.version,
        "checkpoint": checkpoint,
        "scene": scene,
        "position": position,
    }
    number, attempt = _next_attempt(key)
    return create_trial(
        user=user,
        station=station,
        evaluation=evaluation,
        scene=scene,
        position=position,
        checkpoint=checkpoint,
        number=number,
        attempt=attempt,
        seed=seed,
    )


def create_trial(
    *,
    user: User,
    station: Station,
    evaluation: Evaluation,
    scene: Scene,
    position: Position,
    checkpoint: Checkpoint,
    number: int,
    attempt: int,
    seed: int | None = None,
    strategy: Mapping[str, Any] | None = None,
    worker: str | None = None,
) -> Trial:
    """Create a prepared trial with exactly this number and attempt, at the station or at its copy `worker`.

    The caller has found out, in the same transaction, that this number and attempt are the next.

    Raises:
        Conflict: The station has an unfinished trial; the message has advice.
        IntegrityError: The number and attempt exist already.
    """
    require_role(user, Role.OPERATOR)
    _check_choice(station, scene, position, checkpoint, seed)
    Station.objects.select_for_update().get(pk=station.pk)  # serializes preparation at this station
    require_none_open(station, worker)
    if seed is None and station.simulated:
        seed = seed_of(scene, position, number)
    return Trial.objects.create(
        evaluation=evaluation,
        evaluation_version=evaluation.version,
        checkpoint=checkpoint,
        scene=scene,
        position=position,
        number=number,
        attempt=attempt,
        station=station,
        worker=worker,
        operator=user,
        instruction=scene.instruction,
        time_limit_s=scene.time_limit_s,
        seed=seed,
        strategy=checkpoint.strategy if strategy is None else strategy,
    )


def require_none_open(station: Station, worker: str | None = None) -> None:
    """Raise Conflict, with advice, if the station, or its copy `worker`, has an unfinished trial."""
    unfinished = trial_open(station, worker)
    if unfinished is not None:
        status = TrialStatus(unfinished.status)
        raise Conflict(
            _UNFINISHED(
                trial=unfinished.pk, name=station.name, label=status.label, advice=lifecycle.advice(status)
            )
        )


def _next_attempt(key: Mapping[str, Any]) -> tuple[int, int]:
    newest: dict[int, tuple[int, str]] = {}
    attempts = Trial.objects.filter(**key).order_by("number", "attempt")
    for number, attempt, status in attempts.values_list("number", "attempt", "status"):
        newest[number] = (attempt, status)
    for number, (attempt, status) in newest.items():
        if status in lifecycle.REPEATABLE_STATES:
            return number, attempt + 1
    return max(newest, default=0) + 1, 1


def seed_of(scene: Scene, position: Position, number: int) -> int:
    """Return the seed of a simulated bench: equal for all checkpoints, so that their conditions are the same."""
    return zlib.crc32(f"{scene.name}/{position.number}/{number}".encode()) & HIGHEST_SEED


# --- judging -----------------------------------------------------------------------------------------------


def score_trial(
    *,
    user: User,
    trial: Trial,
    milestones: Mapping[object, object],
    times: Mapping[object, object] | None = None,
    success: bool | None = None,
    note: str = "",
    failure: str = "",
    failure_phase: str = "",
    source: str = Score.Source.HUMAN,  # type: ignore[assignment]
    reason: str = "",
    uuid: UUID | str | None = None,
) -> Score:
    """Add a score to a trial. For a scored trial it is a correction, which needs a reason and counts from then on.

    The score is written to the journal first, then to the database, and then published. A request can be a repetition
    because its answer was lost: if its `uuid` was used before or, without a `uuid`, if the score is identical to this
    rater's current one. Then the first score is returned.

    Args:
        milestones: Milestone id -> reached, for every milestone of the scene; empty with source truth: as the bench's
            ground truth has them, with their times.
        times: Milestone id -> time of reaching it [s after the start of the run], if known. If `times` is None in a
            correction, the times of the current score are taken.
        failure, failure_phase: See `failures.check_failure`.

    Raises:
        Conflict: The uuid is that of another score, or the trial cannot be scored.
    """
    require_role(user, Role.OPERATOR)
    if source not in Score.Source.values:
        raise EvaError(_SOURCE(source=source, values=", ".join(Score.Source.values)))
    texts = {
        "note": clean_text("note", note, LONGEST_NOTE),
        **failures.clean_failure(failure_phase=failure_phase, failure=failure),
        "reason": clean_text("reason", reason, LONGEST_NOTE),
    }
    with transaction.atomic():
        run_checks("scored", trial, user)
        locked = lock_trial(trial)
        run_checks("judged", locked, user)
        rows = list(locked.scene.milestones.order_by("order"))
        if source == Score.Source.TRUTH and not milestones and locked.truth is not None:
            milestones, times = truth_ticks(rows, locked.truth, ordered=locked.scene.ordered)
            if success is None and not any(row.required for row in rows):
                success = bool(locked.truth.get("success"))
        when = _times_before(locked, rows, milestones) if times is None else times
        fails = bool(failing(locked))
        judged = partial(
            score_outcome, rows, milestones, success, times=when, ordered=locked.scene.ordered, fails=fails
        )
        values = {"rater": user, "source": source, **texts}
        first = (
            locked.verdict if uuid is None else Score.objects.filter(uuid=parse_command_uuid(uuid)).first()
        )
        if first is not None and first.trial == locked and _is_same_score(first, values, judged()):
            return first
        if first is not None and uuid is not None:
            raise Conflict(_UUID_OF_ANOTHER_SCORE(uuid=uuid, trial_id=first.trial_id))
        require_scorable(locked, texts["reason"])
        outcome = judged()
        run_checks(f"judged {'success' if outcome.success else 'failure'}", locked, user)
        if uuid is None:
            _reject_repeat(locked, values, outcome)
        if source == Score.Source.TRUTH:
            _require_truth(locked, outcome)
        failures.check_failure(
            locked.scene,
            texts,
            success=outcome.success,
            by_person=source == Score.Source.HUMAN,
            said=failures.score_failure(locked.verdict),
        )
        if locked.status == TrialStatus.SCORED and _judges_alike(locked.verdict, outcome):
            run_checks("reworded", locked, user)
        elif locked.verdict is not None:
            require_own(locked, user)
        score = Score(
            uuid=parse_command_uuid(uuid),
            trial=locked,
            success=outcome.success,
            score=outcome.score,
            **values,
        )
        counts_now(locked, score, _outcomes(score, outcome), user)
    trial.refresh_from_db()
    return score


def abandon_trial(*, user: User, trial: Trial, reason: str = "") -> Trial:
    """Abandon a trial that never ran; its number is used again by another attempt."""
    require_role(user, Role.OPERATOR)
    text = clean_text("reason", reason, LONGEST_NOTE) or "abandoned"
    with transaction.atomic():
        locked = lock_trial(trial)
        text = f"{text} ({user.get_username()})"
        if (locked.status, locked.reason) == (TrialStatus.ABANDONED, text):
            return locked  # repeated request whose answer was lost
        require_own(locked, user)
        lifecycle.apply(locked, Transition.ABANDON)
        locked.reason = text
        locked.save()
        notify_settled(locked, user)
    trial.refresh_from_db()
    return trial


@transaction.atomic
def dismiss_trial(*, trial: Trial, reason: str) -> Trial:
    """Set aside a trial that a program has begun and that its plan does not need any more; others are unchanged."""
    locked = lock_trial(trial)
    if locked.worker and lifecycle.allows(locked, Transition.DISMISS):
        lifecycle.apply(locked, Transition.DISMISS)
        locked.reason = reason
        locked.save()
    return locked


def request_publication(trial: Trial) -> None:
    """Queue the publication of the trial's episode to the dataset with its current score."""
    if trial.episode is not None:
        request_publish(episode=trial.episode)


def notify_settled(trial: Trial, user: Any) -> None:
    """Call the functions registered by `register_settled`."""
    for on_settled in _settled:
        on_settled(trial, user)


def lock_trial(trial: Trial) -> Trial:
    """Return the trial with its row locked until the transaction ends."""
    return Trial.objects.select_for_update().get(pk=trial.pk)


def _reject_repeat(trial: Trial, values: Mapping[str, Any], outcome: ScoredOutcome) -> None:
    """Raise Conflict if the new score equals an earlier score of the same rater.

    Such a score may be a late copy of a request whose score has been corrected since.
    """
    before = trial.scores.filter(rater=values["rater"]).prefetch_related("outcomes")
    if any(_is_same_score(score, values, outcome) for score in before):
        raise Conflict(_SAID_BEFORE(trial=trial.pk))


def _require_truth(trial: Trial, outcome: ScoredOutcome) -> None:
    """Raise EvaError if a score that was declared as the bench's ground truth differs from that ground truth.

    This includes trials for which the bench reported no ground truth.
    """
    if trial.truth is None:
        raise EvaError(_BENCH_SAYS_NOTHING(trial=trial.pk))
    milestones = [milestone for milestone, _, _ in outcome.reached]
    counts, _ = truth_ticks(milestones, trial.truth, ordered=trial.scene.ordered)
    for milestone, reached, _ in outcome.reached:
        truth = counts[milestone.pk]
        if reached != truth:
            raise EvaError(
                _BENCH_SAYS_OTHERWISE(milestone=milestone.text, said=reached, trial=trial.pk, truth=truth)
            )


def _is_same_score(score: Score, values: Mapping[str, Any], scored: ScoredOutcome) -> bool:
    """Return True if the score equals the given one."""
    outcomes = {outcome.milestone_id: (outcome.reached, outcome.at_s) for outcome in score.outcomes.all()}
    same = outcomes == {milestone.pk: (reached, at) for milestone, reached, at in scored.reached}
    same_values = all(getattr(score, name) == value for name, value in values.items())
    return same and same_values and score.success == scored.success


def _judges_alike(score: Score | None, outcome: ScoredOutcome) -> bool:
    """Return True if the score has the same milestones and success, so that only texts differ."""
    if score is None or score.success != outcome.success:
        return False
    reached_before = dict(score.outcomes.values_list("milestone_id", "reached"))
    return reached_before == {milestone.pk: reached for milestone, reached, _ in outcome.reached}


def _times_before(
    trial: Trial, milestones: Sequence[Milestone], ticks: Mapping[object, object]
) -> dict[object, float]:
    """Return the times [s] at which milestones were reached according to the current score, by id of the milestone.

    Only milestones that are still ticked are included. The result is {} if the scene now forbids these times, because a
    time limit or the order of the milestones is violated.
    """
    outcomes = trial.verdict.outcomes.exclude(at_s=None) if trial.verdict else ()
    seconds = {outcome.milestone_id: outcome.at_s for outcome in outcomes if outcome.reached}
    ticked = {str(key) for key, reached in ticks.items() if reached is True}
    retained = [(row, seconds[row.pk]) for row in milestones if row.pk in seconds and str(row.pk) in ticked]
    late = any(row.time_limit_s is not None and at > row.time_limit_s for row, at in retained)
    times = [at for _, at in retained]
    return (
        {}
        if late or (trial.scene.ordered and sorted(times) != times)
        else {row.pk: at for row, at in retained}
    )


def require_scorable(trial: Trial, reason: str) -> None:
    """Raise Conflict or EvaError if the trial cannot be scored.

    A trial that is scored already can only be corrected, and needs a `reason` for that.
    """
    lifecycle.require(trial, Transition.SCORE)
    if trial.status == TrialStatus.SCORED and not reason:
        raise EvaError(_SCORED_ALREADY(trial=trial.pk))
    if trial.status == TrialStatus.INTERRUPTED and _repeated(trial):
        raise Conflict(_REPEATED_SINCE(trial=trial.pk))
    counting = attempts_of(trial=trial).filter(status=TrialStatus.SCORED).exclude(pk=trial.pk).first()
    if counting is not None:  # e.g. this trial was abandoned, but its run turns out to have been accepted
        raise Conflict(_ANOTHER_COUNTS(other=counting.pk, trial=trial.pk))
    unrecorded = "" if trial.status == TrialStatus.SCORED else why_unrecorded(episode=trial.episode)
    if unrecorded:
        raise Conflict(_NEVER_RAN(trial=trial.pk, unrecorded=unrecorded))


def require_own(trial: Trial, user: User) -> None:
    """Raise NotAllowed unless the user is the trial's operator, the station's lease holder or an administrator."""
    if user.pk == trial.operator_id or role_of(user) is Role.ADMIN:
        return
    lease = lease_open(station=trial.station)
    if lease is None or lease.user_id != user.pk:
        named = {"operator": trial.operator.get_username(), "user": user.get_username()}
        raise NotAllowed(_OF_ANOTHER(trial=trial.pk, station=trial.station.name, **named))


def _repeated(trial: Trial) -> bool:
    newest = attempts_of(trial=trial).aggregate(newest=Max("attempt"))["newest"]
    return bool(newest > trial.attempt)


def _outcomes(score: Score, outcome: ScoredOutcome) -> list[MilestoneOutcome]:
    return [
        MilestoneOutcome(
            score=score,
            milestone=milestone,
            order=milestone.order,
            text=milestone.text,
            points=milestone.points,
            required=milestone.required,
            reached=reached,
            at_s=at,
        )
        for milestone, reached, at in outcome.reached
    ]


def counts_now(trial: Trial, score: Score, outcomes: Sequence[MilestoneOutcome], user: User) -> None:
    """Store a new score of the trial with its milestone outcomes; this score counts from then on.

    The score is written to the journal first, then to the database, and its publication is requested last.
    """
    milestones = [OutcomeLine.written(outcome) for outcome in outcomes]
    JUDGEMENTS.append(journal_uuid(trial), ScoreLine.written(score, milestones=milestones))
    score.save()
    MilestoneOutcome.objects.bulk_create(outcomes)
    lifecycle.apply(trial, Transition.SCORE)
    trial.verdict = score
    trial.save()
    request_publication(trial)
    notify_settled(trial, user)


def require_reason(reason: str, when: str) -> str:
    text = clean_text("reason", reason, LONGEST_NOTE)
    if not text:
        raise EvaError(_NO_REASON(when=when))
    return text
