"""Restoring of lost trials and scores from manifests and scores files.

Existing rows are not overwritten, except that a row that is older than the files (from a backup) is updated from them.
Scenes, positions, checkpoints and users that are missing too are created by name, deactivated, and marked as
placeholders.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from django.core.management.color import no_style
from django.db import connection, transaction
from django.db.models import Max
from django.utils import timezone

from evaweb.accounts.roles import get_or_create_person
from evaweb.core.errors import EvaError
from evaweb.episodes import services as episodes
from evaweb.episodes.folders import journal_folder
from evaweb.episodes.manifest import CLOSED, read_recorded_episode
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.reconcile import RestorableRun, register_restorer
from evaweb.episodes.selectors import why_unrecorded
from evaweb.records.journal import missing_rows
from evaweb.trials import lifecycle, placeholders
from evaweb.trials.models import (
    Milestone,
    MilestoneOutcome,
    Scene,
    Score,
    Trial,
    TrialStatus,
    VoidRequest,
)
from evaweb.trials.record import (
    Judgement,
    OutcomeLine,
    ScoreLine,
    TrialRecord,
    VoidAnswerLine,
    VoidLine,
    VoidRequestLine,
    trial_of_manifest,
)
from runtime.core.sentences import Pattern
from runtime.recording.reader import read_events

log = logging.getLogger(__name__)
_SCORES_SEVERAL_TRIALS = Pattern(
    "trials.restoring.scores_several_trials",
    "its scores are of several trials: {named}",
)
_TRIAL_HAS_EPISODE_CANNOT_HAVE = Pattern(
    "trials.restoring.trial_has_episode_cannot_have",
    "trial {trial} has episode {episode_id}, and cannot have another one",
)

_BEHIND = (*lifecycle.OPEN_STATES, TrialStatus.ABANDONED)  # outdated if the recording is closed
_GHOST_S = 0.1  # runs that never began have durations of a few hundredths of a second


@register_restorer
def restore(kept: RestorableRun) -> int:
    """Restore the trial of a run and its scores if they are missing; return the number of restored rows."""
    request = read_recorded_episode(journal_folder(kept.uuid)).trial if kept.recorded else {}
    lines = _judgements(kept, request)
    if not lines and Trial.objects.filter(episode_id=kept.uuid).exclude(status__in=_BEHIND).exists():
        return 0
    facts = _facts(lines, request)
    episode = Episode.objects.filter(uuid=kept.uuid).first()
    if facts is None or not (lines or (episode is not None and episode.status in CLOSED)):
        return 0
    with transaction.atomic():
        trial, created = _trial(facts, kept, episode)
        scores = _scores(trial, [line for line in lines if isinstance(line, ScoreLine)])
        _apply_outcomes(trial, lines)
        scores += _restore_void_requests(trial, lines)
        if created or scores:
            _publish(trial, made=created)
    if never := _never_ran_reason(trial):
        kept.report_problem(never)
    return created + scores


def _never_ran_reason(trial: Trial) -> str:
    """Return a warning for a scored trial whose recording was never opened, which earlier versions allowed; else ""."""
    if trial.status != TrialStatus.SCORED or trial.episode is None or (trial.duration_s or 0.0) >= _GHOST_S:
        return ""
    reason = why_unrecorded(episode=trial.episode)
    return reason and f"trial {trial.pk} is scored and never ran, {reason}: void it with a reason"


def _judgements(run: RestorableRun, request: Mapping[str, Any]) -> list[Judgement]:
    """Return the lines of the run's scores file that belong to its trial, the last one for each score's uuid.

    A score was written twice if its first write to the database failed. Lines of another trial than the recording's,
    from a copied file, are reported and skipped.
    """
    lines = [line for line in run.lines if isinstance(line, Judgement)]
    own = request.get("uuid", "")
    foreign = [str(line.trial.uuid) for line in lines if run.recorded and str(line.trial.uuid) != own]
    if foreign:
        run.report_problem(
            f"run {run.uuid}: {len(foreign)} of its scores are of trial {', '.join(dict.fromkeys(foreign))}, "
            f"its recording is of {f'trial {own}' if own else 'no trial'}: left out"
        )
    lines = [line for line in lines if str(line.trial.uuid) not in foreign]
    last = {line.uuid: line for line in lines if isinstance(line, ScoreLine)}
    return [line for line in lines if not isinstance(line, ScoreLine) or line is last[line.uuid]]


def _facts(lines: Sequence[Judgement], request: Mapping[str, Any]) -> TrialRecord | None:
    """Return the trial's record: from the newest line, which is most complete, else from the manifest."""
    named = {line.trial.uuid for line in lines}
    if len(named) > 1:
        raise EvaError(_SCORES_SEVERAL_TRIALS(named=", ".join(sorted(map(str, named)))))
    return lines[-1].trial if lines else trial_of_manifest(request)


# --- the trial ---------------------------------------------------------------------------------------------


def _trial(facts: TrialRecord, run: RestorableRun, episode: Episode | None) -> tuple[Trial, bool]:
    """Return the trial's row, locked, and whether it was created."""
    trial = Trial.objects.select_for_update().filter(uuid=facts.uuid).first()
    if trial is None:
        return _create(facts, _episode(facts, run, episode)), True
    if run.uuid not in (trial.uuid, trial.episode_id or run.uuid):
        raise EvaError(_TRIAL_HAS_EPISODE_CANNOT_HAVE(trial=trial.pk, episode_id=trial.episode_id))
    if trial.status in _BEHIND:
        for name, value in _run_values(facts, _episode(facts, run, episode)).items():
            setattr(trial, name, value)
        log.warning("trial %s was behind its recording: it is %s now", trial.pk, trial.status)
        trial.save()
    elif trial.episode is None and (own_episode := _episode(facts, run, episode)):
        trial.episode = own_episode
        trial.save()
    return trial, False


def _episode(facts: TrialRecord, run: RestorableRun, episode: Episode | None) -> Episode | None:
    """Return the trial's recording; None for a trial without a recording.

    If the folder of the recording is lost, its row is created with the status "missing".
    """
    if episode is not None or run.uuid == facts.uuid:
        return episode
    return episodes.create_missing_episode(
        station=placeholders.station(facts),
        uuid=run.uuid,
        task=facts.instruction,
        checkpoint=facts.checkpoint,
        operator=facts.operator,
        started_at=facts.started_at,
        duration_s=facts.duration_s,
    )


def _create(facts: TrialRecord, episode: Episode | None) -> Trial:
    """Create the trial with its original id if that is free, so that URLs of trials stay valid."""
    station, scene = placeholders.station(facts), placeholders.scene(facts)
    key = {
        "evaluation": placeholders.evaluation(facts, station),
        "evaluation_version": facts.version,
        "checkpoint": placeholders.checkpoint(facts),
        "scene": scene,
        "position": placeholders.position(scene, facts.position),
    }
    course = _run_values(facts, episode)
    trial = Trial.objects.create(
        pk=None if Trial.objects.filter(pk=facts.id).exists() else facts.id,
        station=station,
        operator=get_or_create_person((episode.operator if episode else "") or facts.operator),
        **(facts.pre_run_fields() | key | course | _numbered(facts, key, course["reason"])),
    )
    prepared_at = facts.prepared_at or course["started_at"] or timezone.now()
    Trial.objects.filter(pk=trial.pk).update(prepared_at=prepared_at)  # `create` sets the current time
    _advance_sequence(Trial)
    return Trial.objects.get(pk=trial.pk)


def _numbered(facts: TrialRecord, key: Mapping[str, Any], reason: str) -> dict[str, Any]:
    """Return number, attempt and reason of a trial to be created.

    If another trial has this number and attempt now, it gets the next free number, with a note in the reason.
    """
    same = Trial.objects.filter(**key)
    if not same.filter(number=facts.number, attempt=facts.attempt).exists():
        return {"number": facts.number, "attempt": facts.attempt}
    newest = same.aggregate(newest=Max("number"))["newest"]
    was = f"restored as another number: it was {facts.number}, attempt {facts.attempt}"
    return {"number": newest + 1, "attempt": 1, "reason": f"{reason} ({was})" if reason else was}


def _run_values(facts: TrialRecord, episode: Episode | None) -> dict[str, Any]:
    """Return the outcome of the run from the trial's record, completed from its recording."""
    ended_at, truth = _end(episode) if episode else (None, None)
    exact = episode.duration_s if episode else None
    missing = episode is None or episode.status == EpisodeStatus.MISSING
    whole = missing or (episode.status == EpisodeStatus.FINISHED and episode.frames > 0)
    return {
        **facts.run_fields(),
        "episode": episode,
        "status": TrialStatus.ENDED if whole else TrialStatus.INTERRUPTED,
        "reason": facts.reason or (episode.reason if episode else ""),
        "started_at": facts.started_at or (episode.started_at if episode else None),
        "ended_at": facts.ended_at or ended_at,
        "duration_s": exact if exact is not None else facts.duration_s,
        "truth": facts.truth or truth,
    }


def _end(episode: Episode) -> tuple[datetime | None, Mapping[str, Any] | None]:
    """Return when the recording was closed, and the last ground truth in its events."""
    if episode.status not in CLOSED:
        return None, None
    folder = journal_folder(episode.uuid)
    events = (json.loads(line) for line in read_events(folder / "events.jsonl").lines)
    truths = [event.get("data") for event in events if event.get("kind") == "truth"]
    return read_recorded_episode(folder).ended_at, truths[-1] if truths else None


# --- scores and voids --------------------------------------------------------------------------------------


def _scores(trial: Trial, lines: Sequence[ScoreLine]) -> int:
    """Add the missing scores; return their number."""
    lost = missing_rows(Score, lines, trial=trial)
    for line in lost:
        _score(trial, line)
    if lost:
        trial.verdict = _newest(trial, lines)
        trial.save()
    return len(lost)


def _newest(trial: Trial, lines: Sequence[ScoreLine]) -> Score:
    """Return the score that counts.

    Normally it is the score of the last of `lines`, which are the lines of one scores file. A trial has two scores
    files if its episode was found late. If the trial's current score was restored from the other file and is newer, the
    current score counts.
    """
    newest, current = Score.objects.get(uuid=lines[-1].uuid), trial.verdict
    elsewhere = current is not None and current.uuid not in [line.uuid for line in lines]
    return current if current and elsewhere and current.scored_at > newest.scored_at else newest


def _score(trial: Trial, line: ScoreLine) -> None:
    score = Score.objects.create(trial=trial, **line.to_row_values())
    by_key = _milestones(trial.scene, line.milestones)
    MilestoneOutcome.objects.bulk_create(
        MilestoneOutcome(
            score=score, milestone=by_key.get((outcome.order, outcome.text)), **outcome.to_row_values()
        )
        for outcome in line.milestones
    )


def _milestones(scene: Scene, outcomes: Sequence[OutcomeLine]) -> dict[tuple[int, str], Milestone]:
    """Return the scene's milestones by order and text.

    A placeholder scene gets the milestones of the first score that has any.
    """
    if (
        not scene.active
        and scene.criterion.startswith(placeholders.PLACEHOLDER_NOTE)
        and not scene.milestones.exists()
    ):
        for outcome in outcomes:
            Milestone.objects.create(scene=scene, **outcome.model_dump(exclude={"reached", "at_s"}))
    return {(milestone.order, milestone.text): milestone for milestone in scene.milestones.all()}


def _apply_outcomes(trial: Trial, lines: Sequence[Judgement]) -> None:
    """Set the status that follows from the lines; a void is final."""
    void = next((line for line in lines if isinstance(line, VoidLine)), None)
    requests = [line for line in lines if isinstance(line, VoidRequestLine | VoidAnswerLine)]
    if void is not None and trial.status != TrialStatus.VOIDED:
        for name, value in {"status": TrialStatus.VOIDED, **void.to_row_values()}.items():
            setattr(trial, name, value)
        trial.save()
    elif void is None and lines:
        waits = bool(requests) and isinstance(requests[-1], VoidRequestLine)
        status = TrialStatus.VOID_ASKED if waits else TrialStatus.SCORED
        if trial.status not in lifecycle.SCORED_STATES or (requests and trial.status != status):
            trial.status = status
            trial.save()


def _restore_void_requests(trial: Trial, lines: Sequence[Judgement]) -> int:
    """Restore missing void requests and answers; return the number of added or updated rows."""
    answers = {line.uuid: line.to_row_values() for line in lines if isinstance(line, VoidAnswerLine)}
    missing = missing_rows(
        VoidRequest, [line for line in lines if isinstance(line, VoidRequestLine)], trial=trial
    )
    for line in missing:
        VoidRequest.objects.create(trial=trial, **line.to_row_values(), **answers.get(line.uuid, {}))
    behind = VoidRequest.objects.filter(uuid__in=answers, answer="")
    for row in behind:
        VoidRequest.objects.filter(pk=row.pk).update(**answers[row.uuid])
    return len(missing) + len(behind)


def _publish(trial: Trial, *, made: bool) -> None:
    """Queue the publication of a scored trial's episode, if it may be missing in the dataset or be out of date.

    Its job was lost with the database. `made` is True if the row of the trial was created just now; then an episode
    that is in a dataset is not published again.
    """
    episode = trial.episode
    if trial.status not in lifecycle.SCORED_STATES or episode is None or episode.status not in CLOSED:
        return
    if not made or episode.dataset_index is None:
        episodes.request_publish(episode=episode)


def _advance_sequence(model: type[Trial]) -> None:
    """Advance the database's id sequence past the explicitly assigned ids."""
    statements = connection.ops.sequence_reset_sql(no_style(), [model])
    with connection.cursor() as cursor:
        for statement in statements:
            cursor.execute(statement)
