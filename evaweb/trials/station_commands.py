"""Commands of a trial: arguments of its set-up and run, and effects of their answers on the trial.

Includes the set-up for a checkpoint without a trial.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any
from uuid import UUID

from django.contrib.auth.models import User
from django.db import transaction

from evaweb.accounts.roles import Role, require_role
from evaweb.blinding.visibility import visibility_for_user
from evaweb.core.binary_frames import to_json_value
from evaweb.core.errors import Conflict, EvaError
from evaweb.stations.commands import TABLES, issue_command, parse_command_uuid
from evaweb.stations.models import CARRIED_OUT, NOT_CARRIED_OUT, Command
from evaweb.stations.runtime_client import connection_to
from evaweb.stations.selectors import last_set_up
from evaweb.trials import lifecycle
from evaweb.trials.models import Checkpoint, Trial, TrialStatus
from evaweb.trials.record import TrialRecord
from evaweb.trials.services import run_checks
from evaweb.trials.station_events import begin_run
from evaweb.trials.tables import simulated_bench
from runtime.core.sentences import Pattern, fixed

_CHECKPOINT_OF_SETUP_ALONE = Pattern(
    "trials.station_commands.checkpoint_of_setup_alone",
    "{kind} takes no checkpoint: setup does",
)
_NAMED_TWICE = fixed(
    "trials.station_commands.named_twice",
    "args say policy or checkpoint beside the checkpoint that is named: give one of them",
)
_CHECKPOINT_OFF = Pattern(
    "trials.station_commands.checkpoint_off",
    "checkpoint {name} is switched off: choose another one",
)
_AT_A_COPY = Pattern(
    "trials.station_commands.at_a_copy",
    "trial {trial} is run at a copy of {name}, not at the station itself: no {what}",
)
_NOT_IN_THIS_STATE = Pattern(
    "trials.station_commands.not_in_this_state",
    "trial {trial} is {label} and cannot be {what}: {advice}; a repetition is another trial",
)
_CHECKPOINT_OFF_SINCE = Pattern(
    "trials.station_commands.checkpoint_off_since",
    "checkpoint {label} was switched off since trial {trial} was prepared: abandon it, and choose another one",
)
_NOT_SET_UP = Pattern(
    "trials.station_commands.not_set_up",
    "trial {trial} is not set up: press Set up, then Run",
)
_SET_UP_FOR_ELSE = Pattern(
    "trials.station_commands.set_up_for_else",
    "{name} was set up for something else since trial {trial} was: press Set up again",
)
_SET_UP_BY_SOMEONE = Pattern(
    "trials.station_commands.set_up_by_someone",
    "{name} was set up for {other} by someone else, not for {label}: press Set up again",
)
_UUID_OF_ANOTHER = Pattern(
    "trials.station_commands.uuid_of_another",
    "uuid {uuid} is that of another command ({first}), which was not for trial {trial}; each needs one of "
    "its own",
)


def trial_command(
    *,
    user: User,
    trial: Trial,
    kind: str,
    page: str,
    epoch: int,
    boot: str,
    sequence: int,
    uuid: UUID | str | None = None,
    args: Mapping[str, Any] | None = None,
) -> Command:
    """Send a command for a trial.

    The commands "setup" and "run" get their arguments from the trial, other commands from `args`. After an accepted run
    the trial is running, and the database has a row for its episode. Never call this within a transaction.

    Raises: Conflict if the trial is not prepared, or the station was last set up for something else.
    """
    require_role(user, Role.OPERATOR)
    identity = parse_command_uuid(uuid)
    request = {
        "user": user,
        "station": trial.station,
        "kind": kind,
        "page": page,
        "epoch": epoch,
        "boot": boot,
        "sequence": sequence,
        "uuid": identity,
    }
    if kind == "setup":
        return _set_up(trial, request)
    if kind == "run":
        return _run(trial, request)
    return issue_command(**request, args=dict(args or {}))


def checkpoint_command(
    *, user: User, checkpoint: Checkpoint, kind: str, args: Mapping[str, Any] | None = None, **given: Any
) -> Command:
    """Set a station up for a checkpoint without a trial; the other arguments are those of `issue_command`.

    Raises: EvaError if `kind` is not "setup".
    """
    require_role(user, Role.OPERATOR)
    if kind != "setup":
        raise EvaError(_CHECKPOINT_OF_SETUP_ALONE(kind=kind))
    if "policy" in (args or {}) or "checkpoint" in (args or {}):
        raise EvaError(_NAMED_TWICE)
    if not checkpoint.active:
        raise Conflict(_CHECKPOINT_OFF(name=checkpoint.name))
    return issue_command(
        user=user, kind=kind, args={**(args or {}), **_policy_args(checkpoint)}, vouched=TABLES, **given
    )


def _policy_args(checkpoint: Checkpoint) -> dict[str, Any]:
    args = {"policy": checkpoint.policy, "checkpoint": {"id": checkpoint.pk, "name": checkpoint.name}}
    return args if checkpoint.strategy is None else {**args, "strategy": checkpoint.strategy}


Least = Callable[[Trial], Mapping[str, float] | None]
_least: list[Least] = []


def register_min_stage_times(find: Least) -> None:
    """Register a function that returns least durations of set-up stages [s] for a trial, None for no minimum."""
    _least.append(find)


def setup_args(trial: Trial, reset: UUID) -> dict[str, Any]:
    """Return the arguments of the station's set-up for this trial; `reset` identifies this reset of a simulated bench.

    Every set-up connects, warms up and queries the policy, also if the checkpoint is the same as before.
    """
    args: dict[str, Any] = {"task": trial.instruction, **_policy_args(trial.checkpoint)}
    if trial.strategy is not None:
        args["strategy"] = trial.strategy
    for least in (table for find in _least if (table := find(trial))):
        args["least"] = dict(least)
    if trial.station.simulated and trial.seed is not None:
        laid = simulated_bench(trial.position.bench)
        args["bench"] = {"id": str(reset), "seed": trial.seed, "positions": laid}
        # Without a layout, any bench would accept the scene.
        args["bench"] |= {"of": trial.scene.bench, "schema_digest": trial.scene.bench_digest}
        for key in ("factors", "choices"):
            if asked := (trial.position.bench or {}).get(key):
                args["bench"][key] = asked
    return args


def run_args(trial: Trial, user: User) -> dict[str, Any]:
    """Return the run's arguments: manifest data and time limit; the mode is always continuous."""
    args: dict[str, Any] = {
        "trial": TrialRecord.for_manifest(trial),
        "operator": user.get_username(),
        "mode": "continuous",
    }
    if trial.time_limit_s is not None:
        args["duration_s"] = trial.time_limit_s
    return args


def _set_up(trial: Trial, request: Mapping[str, Any]) -> Command:
    first = Command.objects.filter(pk=request["uuid"]).first()
    if first is None:
        _require_prepared(trial, "set up", request["user"])
    args = setup_args(trial, request["uuid"])
    if first is not None:
        _require_same(
            first,
            trial,
            trial.setup == first.pk or _setup_identity(first.args) == _setup_identity(to_json_value(args)),
        )
        args = first.args
    row = issue_command(**request, args=args, vouched=TABLES)
    if row.status not in NOT_CARRIED_OUT:
        with transaction.atomic():
            locked = _lock_trial(trial)
            if locked.status == TrialStatus.PREPARED:
                locked.setup = row.pk
                locked.save()
    trial.refresh_from_db()
    return row


def _setup_identity(args: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments that identify a set-up.

    The least durations of the set-up's stages are left out, because they are drawn anew for each set-up.
    """
    return {key: value for key, value in args.items() if key != "least"}


def _run(trial: Trial, request: Mapping[str, Any]) -> Command:
    first = Command.objects.filter(pk=request["uuid"]).first()
    if first is None:
        _require_prepared(trial, "run", request["user"])
        _require_set_up(trial)
        took = _require_loaded(trial, request["user"])
        Trial.objects.filter(pk=trial.pk).update(setup_took=took)
        run_checks("run", trial, request["user"])
    else:
        _require_same(first, trial, _is_about(first, trial))
    args = first.args if first else run_args(trial, request["user"])
    row = issue_command(**request, args=args)
    if row.status in CARRIED_OUT:
        with transaction.atomic():
            begin_run(_lock_trial(trial), command=row, episode=_episode_of(row))
    trial.refresh_from_db()
    return row


def _require_prepared(trial: Trial, action: str, user: User) -> None:
    if trial.worker:
        raise Conflict(_AT_A_COPY(trial=trial.pk, what=action, name=trial.station.name))
    status = TrialStatus(_held_status(trial))
    if status is not TrialStatus.PREPARED:
        raise Conflict(
            _NOT_IN_THIS_STATE(
                trial=trial.pk, label=status.label, what=action, advice=lifecycle.advice(status)
            )
        )
    run_checks("prepared", trial, user)
    if not trial.checkpoint.active:
        raise Conflict(
            _CHECKPOINT_OFF_SINCE(label=visibility_for_user(user).checkpoint_label(trial), trial=trial.pk)
        )


def _require_set_up(trial: Trial) -> None:
    """Raise Conflict unless the station's last set-up that may have been carried out was for this trial."""
    last = last_set_up(station=trial.station)
    mine = Trial.objects.values_list("setup", flat=True).get(pk=trial.pk)
    if mine is None:
        raise Conflict(_NOT_SET_UP(trial=trial.pk))
    if last != mine:
        raise Conflict(_SET_UP_FOR_ELSE(name=trial.station.name, trial=trial.pk))


def _require_loaded(trial: Trial, user: User) -> dict[str, float] | None:
    """Raise Conflict unless the station has the trial's checkpoint loaded.

    It does not matter which client set the station up last. If the set-up changes after this check, the run is stale,
    and the station refuses to run it.

    Returns:
        Durations of the policy's set-up stages [s], None if unknown.
    """
    status = connection_to(trial.station.name).status()
    loaded = status.get("checkpoint") or {}
    if loaded.get("id") != trial.checkpoint_id:
        visibility = visibility_for_user(user)
        loaded_name = (
            "another checkpoint" if loaded.get("id") in visibility.checkpoints else loaded.get("name")
        )
        raise Conflict(
            _SET_UP_BY_SOMEONE(
                name=trial.station.name,
                other=loaded_name or "no checkpoint",
                label=visibility.checkpoint_label(trial),
            )
        )
    took = status.get("setup_took")
    return {str(name): float(seconds) for name, seconds in took.items()} if took else None


def _require_same(first: Command, trial: Trial, same: bool) -> None:
    """Raise Conflict unless `same` is True.

    `first` is the earlier command with the uuid of a new one; `same` is whether it is the same command for this trial.
    """
    if not same:
        raise Conflict(_UUID_OF_ANOTHER(uuid=first.pk, first=first, trial=trial.pk))


def _is_about(row: Command, trial: Trial) -> bool:
    return (row.args.get("trial") or {}).get("uuid") == str(trial.uuid)


def _episode_of(row: Command) -> UUID | None:
    episode = row.data.get("episode")
    return UUID(episode) if episode else None


def _lock_trial(trial: Trial) -> Trial:
    return Trial.objects.select_for_update().get(pk=trial.pk)


def _held_status(trial: Trial) -> str:
    return Trial.objects.values_list("status", flat=True).get(pk=trial.pk)
