"""Effects of a station's events on its trial: run started, paused, resumed, ended, not begun, recording closed.

Every event may arrive more than once, from several web processes, and after a gap: a trial stores the number of the
newest event that it has processed, and ignores older ones.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID

from django.db import transaction
from django.utils import timezone

from evaweb.core.errors import EvaError
from evaweb.episodes.models import Episode, EpisodeStatus
from evaweb.episodes.services import record_closed, record_opened, request_publish
from evaweb.stations.commands import resolve_unknown_outcome
from evaweb.stations.models import Command, Station
from evaweb.trials import lifecycle
from evaweb.trials.endings import ending_of
from evaweb.trials.lifecycle import Transition
from evaweb.trials.models import Trial, TrialStatus
from runtime.core.sentences import Pattern
from runtime.ipc.session_state import SessionState

log = logging.getLogger(__name__)
_NOT_RECORDED = Pattern(
    "trials.station_events.not_recorded",
    "trial {trial} was not recorded: its run ended {state}: {reason}",
)


def apply_station_event(
    *, station: Station, event: Mapping[str, Any], boot: str | None = None
) -> Trial | None:
    """Apply one row of a station's event log; return the trial that it changed, or None.

    Args:
        event: number, kind, text, time [s, the runtime's clock], data.
        boot: Boot id of the runtime that numbered the event; None: the station's current one.
    """
    boot = boot if boot is not None else station.boot
    kind, data = event.get("kind"), event.get("data") or {}
    if kind in ("truth", "episode_closed"):
        _find_trial_of(station, _uuid(data.get("episode") or data.get("uuid")))
    with transaction.atomic():
        if kind == "command":
            return _begun(station, event, boot) or _state_entered(station, event, boot)
        if kind == "state":
            return _state_entered(station, event, boot)
        if kind == "truth":
            return _record_truth(station, event)
        if kind == "episode_closed":
            return _episode_closed(station, event)
    return None


def begin_run(trial: Trial, *, command: Command, episode: UUID | None) -> None:
    """Start the trial's run, which the station has accepted.

    This is called when the station answers and, if that answer was lost, when the station's event arrives. The caller
    holds a lock on the trial's row. Idempotent; a run whose recording could not be opened is ignored.
    """
    if Command.objects.filter(pk=command.pk).exclude(unopened="").exists():
        return
    if trial.run is None and _may_begin(trial):
        lifecycle.apply(trial, Transition.RUN)
        trial.run, trial.run_boot, trial.reason = command.pk, command.boot, ""
        trial.started_at = timezone.now()
        trial.operator = command.user or trial.operator
    if trial.run == command.pk and trial.episode_id is None and episode is not None:
        trial.episode = _episode(trial, episode)
    trial.save()


@transaction.atomic
def record_whole_run(*, trial: Trial, events: Sequence[Mapping[str, Any]], state: str, reason: str) -> Trial:
    """Record a run that one program has carried out from beginning to end, without commands and without a live station.

    A trial whose run is recorded already is unchanged.

    Args:
        trial: A prepared trial whose recording is in the lab's folder of episodes.
        events: Rows of the station's event log: number, kind, text, time [s], wall [s since 1970], data.
        state: State of the session at the end of the run.
        reason: Why the run ended.

    Raises:
        EvaError: If no recording was opened and closed.
    """
    locked = Trial.objects.select_for_update().get(pk=trial.pk)
    if locked.status != TrialStatus.PREPARED:
        return locked
    by_kind = {str(event["kind"]): event for event in events}
    opened, closed = by_kind.get("episode_opened"), by_kind.get("episode_closed")
    uuid = _uuid((closed or {}).get("data", {}).get("uuid"))
    if opened is None or closed is None or uuid is None:
        raise EvaError(_NOT_RECORDED(trial=locked.pk, state=state, reason=reason))
    lifecycle.apply(locked, Transition.RUN)
    locked.started_at = datetime.fromtimestamp(opened["wall"], UTC)
    locked.run_since = _time(opened)
    locked.episode = _episode(locked, uuid)
    _apply_transition(locked, _transition_for(state, {}), reason, _time(closed))
    if locked.status not in (TrialStatus.ENDED, TrialStatus.INTERRUPTED):
        _apply_transition(locked, Transition.INTERRUPT, reason, None)
    # The clock of such a run is virtual: real times would show which policy answers fast, also of a blind plan.
    locked.ended_at = locked.started_at + timedelta(seconds=closed["time"] - opened["time"])
    locked.truth = dict(by_kind["truth"]["data"]) if "truth" in by_kind else None
    locked.save()
    record_closed(station=locked.station, data=closed["data"])
    return _episode_closed(locked.station, closed) or locked


def _may_begin(trial: Trial) -> bool:
    open_trials = Trial.objects.filter(
        station=trial.station, worker=trial.worker, status__in=lifecycle.OPEN_STATES
    ).exclude(pk=trial.pk)
    if lifecycle.allows(trial, Transition.RUN) and not open_trials.exists():
        return True
    log.error("trial %s is %s, but %s accepted its run", trial.pk, trial.status, trial.station.name)
    return False


def _episode(trial: Trial, uuid: UUID) -> Episode:
    return record_opened(
        station=trial.station,
        uuid=uuid,
        task=trial.instruction,
        checkpoint=trial.checkpoint.name,
        operator=trial.operator.get_username(),
        kind="rollout",
        mode="continuous",  # as in run_args
    )


def _find_trial_of(station: Station, episode: UUID | None) -> None:
    """Assign a recorded episode to its trial if the station's answer to the run command was lost.

    The lost answer named the episode; the runtime is therefore queried again.
    """
    if episode is None or Trial.objects.filter(episode_id=episode).exists():
        return
    trial = Trial.objects.filter(station=station, episode=None, run__isnull=False).order_by("-pk").first()
    command = (
        Command.objects.select_related("station", "user").filter(pk=trial.run).first() if trial else None
    )
    if trial is None or command is None:
        return
    if _uuid(resolve_unknown_outcome(row=command).data.get("episode")) == episode:
        with transaction.atomic():
            begin_run(Trial.objects.select_for_update().get(pk=trial.pk), command=command, episode=episode)


def _begun(station: Station, event: Mapping[str, Any], boot: str) -> Trial | None:
    """Begin the trial's run when the station reports that it has started to run; return the trial, or None.

    The number of this event is stored, because later events of the station concern this trial.
    """
    data = event.get("data") or {}
    before, after = (SessionState.meaning_of(str(data.get(end))) for end in ("from", "to"))
    if after is None or not after.going or (before is not None and before.going):
        return None
    command = Command.objects.filter(pk=_uuid(data.get("uuid")), station=station, kind="run").first()
    request = (command.args.get("trial") or {}) if command else {}
    trial = _lock_latest(uuid=_uuid(request.get("uuid")), station=station) if request else None
    if command is None or trial is None or trial.run_event is not None:
        return None
    begin_run(trial, command=command, episode=_uuid(command.data.get("episode")))
    if trial.run != command.pk:
        return None
    trial.run_boot, trial.run_event = boot, event["number"]
    trial.run_since = _time(event) if trial.status == TrialStatus.RUNNING else None
    trial.save()
    return trial


def _state_entered(station: Station, event: Mapping[str, Any], boot: str) -> Trial | None:
    data = event.get("data") or {}
    state = data.get("state") or data.get("to")
    trial = _lock_latest(station=station, worker=None, status__in=lifecycle.RUNNING_STATES)
    if trial is None or not state:
        return None
    if trial.run_boot != boot:
        return _runtime_restarted(trial)
    if trial.run_event is None or event["number"] <= trial.run_event:
        return None
    move = _transition_for(state, data.get("unbegun") or {})
    if not lifecycle.allows(trial, move):  # already in that state
        return None
    if move is Transition.GIVE_BACK:
        _reset_to_prepared(trial, _reason(event))
    else:
        _apply_transition(trial, move, _reason(event), _time(event))
        trial.run_event = event["number"]
    trial.save()
    return trial


def _transition_for(state: str, unbegun: Mapping[str, Any]) -> Transition:
    """Return the transition of a trial whose station is now in `state`.

    `unbegun` is the station's report of a run that never began, {} if there is no such report. If no recording was
    opened for the run, the run does not count as an attempt, and the trial is prepared again. If a recording was
    opened, the trial is interrupted and has to be repeated.
    """
    if unbegun:
        return Transition.GIVE_BACK if unbegun.get("unopened") else Transition.INTERRUPT
    session = SessionState.meaning_of(state)
    if session is None or not session.set_up:
        return Transition.INTERRUPT
    return Transition.END if session.ready else Transition.RESUME if session.moving else Transition.PAUSE


def _reset_to_prepared(trial: Trial, reason: str) -> None:
    """Reset the trial to its state before the run command, with the reason."""
    lifecycle.apply(trial, Transition.GIVE_BACK)
    trial.run = trial.run_event = trial.run_since = trial.episode = None
    trial.started_at = trial.duration_s = trial.ended_by = None
    trial.run_boot, trial.reason = "", reason


def _runtime_restarted(trial: Trial) -> Trial:
    """End a trial during which the station was restarted.

    The events of that run are lost, so the trial's recording decides whether the trial ended or was interrupted.
    """
    episode = trial.episode
    if episode is not None and episode.status == EpisodeStatus.FINISHED and episode.frames:
        _apply_transition(trial, Transition.END, episode.reason or "ended while the web was away", None)
        trial.duration_s = episode.duration_s
    else:
        _apply_transition(trial, Transition.INTERRUPT, "the station was restarted during the run", None)
    trial.save()
    return trial


def _apply_transition(trial: Trial, move: Transition, reason: str, time: float | None) -> None:
    """Apply a transition to the trial, and add the time since the run began or was resumed to the trial's duration.

    The duration does not grow during a pause. `time` is the time of the event on the run's clock [s]; if it is None,
    nothing is added.
    """
    if trial.run_since is not None and time is not None:
        trial.duration_s = (trial.duration_s or 0.0) + max(0.0, time - trial.run_since)
    lifecycle.apply(trial, move)
    trial.run_since = time if trial.status == TrialStatus.RUNNING else None
    trial.reason = "" if move is Transition.RESUME else reason
    if move in (Transition.END, Transition.INTERRUPT):
        trial.ended_at = timezone.now()
        # The cause of the end is final, whatever happens to the recording.
        trial.ended_by = trial.ended_by or ending_of(move is Transition.INTERRUPT, reason)


def _record_truth(station: Station, event: Mapping[str, Any]) -> Trial | None:
    """Store the ground truth at the end of an episode."""
    data = dict(event.get("data") or {})
    trial = _lock_latest(station=station, episode_id=_uuid(data.get("episode")))
    if (
        trial is None
        or trial.truth == data
        or (trial.truth is not None and trial.status in lifecycle.SCORED_STATES)
    ):
        return None
    trial.truth = data
    trial.save()
    return trial


def _episode_closed(station: Station, event: Mapping[str, Any]) -> Trial | None:
    """Apply the closing of a recording to its trial, and return the trial.

    The trial gets the exact duration of the recording; an incomplete recording interrupts it.
    """
    data = event.get("data") or {}
    trial = _lock_latest(station=station, episode_id=_uuid(data.get("uuid")))
    if trial is None or data.get("waits"):  # waits for disk space: the event is repeated when it is closed
        return None
    if data.get("rows") == 0 and lifecycle.allows(trial, Transition.INTERRUPT):
        _apply_transition(
            trial, Transition.INTERRUPT, f"nothing of it was recorded: {data.get('reason')}", _time(event)
        )
    _closed_as(trial, str(data.get("status")), str(data.get("reason") or ""), _time(event))
    if trial.episode is not None and trial.episode.duration_s is not None:
        trial.duration_s = trial.episode.duration_s
    trial.save()
    if trial.episode is not None and trial.status in lifecycle.SCORED_STATES:
        request_publish(episode=trial.episode)  # it was scored before its recording was on disk
    return trial


def _closed_as(trial: Trial, status: str, reason: str, time: float | None) -> None:
    if status == EpisodeStatus.FINISHED:
        if trial.status in lifecycle.RUNNING_STATES:
            _apply_transition(trial, Transition.END, reason, time)
    elif lifecycle.allows(trial, Transition.INTERRUPT):
        _apply_transition(trial, Transition.INTERRUPT, f"its recording is {status}: {reason}", time)


def _lock_latest(**key: Any) -> Trial | None:
    """Return the newest trial that matches these conditions, with its row locked until the transaction ends.

    None if there is none, or if a uuid or episode id among the conditions is None.
    """
    if any(value is None for name, value in key.items() if name in ("uuid", "episode_id")):
        return None
    return Trial.objects.select_for_update().filter(**key).order_by("-pk").first()


def _uuid(text: object) -> UUID | None:
    try:
        return UUID(str(text))
    except ValueError:
        return None


def _time(event: Mapping[str, Any]) -> float | None:
    time = event.get("time")
    return float(time) if isinstance(time, int | float) else None


def _reason(event: Mapping[str, Any]) -> str:
    """Return the reason in the text of a station's event.

    For a command event with the text "stop by ann: accepted" it is "stop by ann".
    For a state event with the text "a -> b: why" it is "why".
    """
    before, _, after = str(event.get("text") or "").partition(": ")
    return before if event.get("kind") == "command" else after or before
