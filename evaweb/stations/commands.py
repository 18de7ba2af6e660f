"""Commands to stations: their users, kinds and results.

A command is first written as a row, then sent, then its answer is stored. Stop, halt and e-stop are sent first and
wait for no database.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from typing import Any
from uuid import UUID, uuid4, uuid5

from django.conf import settings
from django.contrib.auth import get_user_model
from django.db import Error, IntegrityError, transaction
from django.utils import timezone

from evaweb.accounts.roles import Role, require_role, role_of
from evaweb.core.binary_frames import to_json_value
from evaweb.core.errors import (
    Conflict,
    EvaError,
    NotAllowed,
    StationGone,
)
from evaweb.stations.lease_holders import holder_of
from evaweb.stations.models import CARRIED_OUT, Command, CommandStatus, Station
from evaweb.stations.runtime_client import NoAnswer, connection_to
from evaweb.stations.selectors import station_get
from evaweb.stations.stop_recorder import StopRecorder
from evaweb.stations.stops import Answer, answer_of, clean_reason, press_estop, request_stop
from evaweb.stations.unwritten_commands import UnwrittenCommands
from runtime.core.sentences import Pattern
from runtime.ipc import messages
from runtime.ipc.bus import CodecError

log = logging.getLogger(__name__)
_DATABASE_SLOW = Pattern(
    "stations.commands.database_slow",
    "not sent: the database took {seconds:.0f} s to write it down; look at the robot, press again",
)
_NO_UUID = Pattern(
    "stations.commands.no_uuid",
    "uuid {given!r:.60}: must be a UUID such as {example}",
)
_UNKNOWN = Pattern(
    "stations.commands.unknown",
    "command {kind!r:.40} is unknown; allowed: {kinds}",
)
_TABLES_FOR_ADMINISTRATORS = Pattern(
    "stations.commands.tables_for_administrators",
    "{kind}: args say {given}, and {user} is {role}: tables are for administrators; allowed: a checkpoint,"
    " or a recorded episode (replay), by its name beside args",
)
_NOT_WRITTEN_DOWN = Pattern(
    "stations.commands.not_written_down",
    "{kind} was not sent: the database does not take it now ({error}); stopping works",
)
_NOT_SENDABLE = Pattern(
    "stations.commands.not_sendable",
    "{kind} cannot be sent with these args: {error}",
)
_UUID_OF_ANOTHER = Pattern(
    "stations.commands.uuid_of_another",
    "uuid {uuid} is that of another command ({first}); each needs one of its own",
)
STOPPING = ("stop", "halt", "estop")  # never expire; the runtime has the same list
COLLECTING = ("arm", "disarm", "label", "discard")
KINDS = (
    *("setup", "run", "stop", "halt", "resume", "home", "release", "record_start", "record_stop", "estop"),
    *("tune", "step", "commit", "cancel", "move", "gripper", "approach"),
    *COLLECTING,
)
TABLES = ("policy", "checkpoint")  # arguments: the policy to query, and its name in recordings
_UNANSWERED = (CommandStatus.PRESSED, CommandStatus.UNKNOWN)
_ANSWER = ("status", "reason", "allowed", "data", "answered_at")
_LONG_AGO = 0.0  # expiry on the runtime's clock: the command must not be carried out any more


class NotSent(EvaError):
    """Error if a command was not sent, because its row could not be written."""

    status = 503


def parse_command_uuid(given: UUID | str | None) -> UUID:
    """Return the uuid of a command, a new one for None. Raises: EvaError if it is malformed."""
    if given is None:
        return uuid4()
    try:
        return UUID(str(given))
    except ValueError:
        raise EvaError(_NO_UUID(given=given, example=uuid4())) from None


def issue_command(
    *,
    user: Any,
    station: Station,
    kind: str,
    args: Mapping[str, Any] | None = None,
    page: str = "",
    epoch: int = 0,
    boot: str = "",
    sequence: int = 0,
    uuid: UUID | str | None = None,
    vouched: Sequence[str] = (),
) -> Command:
    """Send a command and return its row with the answer; if the uuid was used before, return the first row.

    Never call it within a transaction: other processes could not write until the station has answered.

    Args:
        user: User who commands.
        station: Station to command.
        kind: Kind of command.
        args: Arguments of the command.
        page: Id of the page that holds the lease.
        epoch: Epoch of the lease.
        boot, sequence: Boot id and number of the snapshot that the page showed.
        uuid: Uuid of the command, None for a new one.
        vouched: Names of arguments that come from an administrator's table or the lab's records instead of the user.

    Raises:
        NotAllowed: The user lacks the role.
        Conflict: The uuid belongs to another command.
        NotSent: The database did not accept the row.
    """
    row = Command(
        uuid=parse_command_uuid(uuid),
        station=station,
        user=user,
        kind=kind,
        args=to_json_value(dict(args or {})),
        holder=holder_of(user.get_username(), page),
        epoch=epoch,
        boot=boot,
        sequence=sequence,
    )
    if kind not in KINDS:
        raise EvaError(_UNKNOWN(kind=kind, kinds=", ".join(KINDS)))
    if kind == "estop":
        return _stop(row)
    role = require_role(user, Role.OPERATOR)
    if kind in STOPPING:
        return _stop(row)
    _require_no_table(row, role, vouched)
    return _send(row, _message(row, role, vouched))


def _require_no_table(row: Command, role: Role, vouched: Sequence[str]) -> None:
    """Raise NotAllowed if an operator passes a table reserved for administrators; the station checks it again."""
    keys = [key for key in TABLES if row.args.get(key) is not None and key not in vouched]
    if keys and role is not Role.ADMIN:
        raise NotAllowed(
            _TABLES_FOR_ADMINISTRATORS(
                kind=row.kind, given=" and ".join(keys), user=row.user, role=role.with_article
            )
        )


def record_estop(
    *,
    user: Any,
    station: Station,
    why: str,
    uuid: UUID | str,
    answer: Answer,
    at: datetime,
    unverified: str = "",
) -> Command:
    """Queue the row of an e-stop that was pressed at `at`; the row is written when the database accepts it.

    `station` and `user` need only their names. `unverified` is the reason why the user is unknown.
    """
    args = {"why": clean_reason(why)} | ({"unverified": unverified} if unverified else {})
    row = Command(
        uuid=parse_command_uuid(uuid), station=station, user=user, kind="estop", args=args, issued_at=at
    )
    if str(row.uuid) != answer.uuid and answer.data.get("latched") == "anew":  # latched by another press
        answer = replace(answer, data={**answer.data, "latched": "already"})
    return _queue_record(row, answer)


def record_stop(
    *,
    user: Any,
    station: Station,
    kind: str,
    page: str,
    epoch: int,
    uuid: UUID | str,
    answer: Answer,
    at: datetime,
) -> Command:
    """Queue the row of a stop or halt that was sent at `at`; it is written when the database accepts it."""
    fields = {"station": station, "user": user, "kind": kind, "epoch": epoch, "issued_at": at}
    row = Command(uuid=parse_command_uuid(uuid), holder=holder_of(user.get_username(), page), **fields)
    return _queue_record(row, answer)


def resolve_unknown_outcome(*, row: Command) -> Command:
    """Determine the outcome of a command whose answer was lost; leave the row unchanged if it is still unknown.

    The command is sent again, already expired. If the runtime knows its uuid, it repeats the first answer. If not, it
    refuses the command as too late and remembers the refusal, so that the command can never be carried out any more.
    Stopping commands never expire, and are therefore not sent again.
    """
    age = timezone.now() - row.issued_at
    if row.kind in STOPPING or row.status not in _UNANSWERED or age < timedelta(seconds=_patience_s()):
        return row
    try:
        late = _message(row, role_of(row.user) if row.user else "", TABLES, valid_until=_LONG_AGO)
        answer = answer_of(connection_to(row.station.name).request(late))
    except StationGone:
        return row
    _put(row, answer)
    _update(row)
    return row


def record_run_not_opened(*, station: Station, uuid: UUID | str, reason: str) -> None:
    """Record that the recording of an accepted run could not be opened.

    The station's answer to the run command may still arrive later.
    """
    Command.objects.filter(pk=parse_command_uuid(uuid), station=station, kind="run").update(unopened=reason)


def unresolved_commands(*, station: Station) -> list[Command]:
    """Return the commands of the last hour whose answers were lost."""
    now = timezone.now()
    return list(
        station.commands.filter(
            status__in=_UNANSWERED,
            issued_at__lt=now - timedelta(seconds=_patience_s()),
            issued_at__gt=now - timedelta(hours=1),
        )
        .exclude(kind__in=STOPPING)
        .select_related("station", "user")
    )


def _send(row: Command, command: messages.Command) -> Command:
    first = _find_first(row)
    if first is not None:
        return resolve_unknown_outcome(row=first)
    _require_sendable(command)
    pressed = time.monotonic()
    try:
        with transaction.atomic(durable=True):
            row.issued_at = timezone.now()
            row.save(force_insert=True)
    except IntegrityError:  # sent twice concurrently
        first = _find_first(row)
        if first is None:
            raise
        return first
    except Error as error:
        raise NotSent(_NOT_WRITTEN_DOWN(kind=row.kind, error=error)) from error
    # A row that took long to write delays the command; it is then reported as failed instead of moving a robot late.
    _put(row, _send_and_wait(row, command, waited=time.monotonic() - pressed))
    _update(row)
    return row


def _require_sendable(command: messages.Command) -> None:
    """Raise EvaError if the command cannot be encoded.

    This is to be called before the command's row is written. If a row without an answer were left behind, the station
    would be queried for its outcome for an hour.
    """
    try:
        messages.encode(command)
    except CodecError as error:
        raise EvaError(_NOT_SENDABLE(kind=command.kind, error=error)) from None


def _send_and_wait(row: Command, command: messages.Command, waited: float) -> Answer:
    """Send a command and return the answer; `waited` is the time that writing its row took [s]."""
    if waited > settings.EVA_COMMAND_TIMEOUT_S:
        return Answer(CommandStatus.FAILED, _DATABASE_SLOW(seconds=waited))
    try:
        return answer_of(connection_to(row.station.name).request(command, expires=True))
    except NoAnswer as fault:
        return Answer(CommandStatus.UNKNOWN, str(fault))
    except StationGone as fault:
        return Answer(CommandStatus.FAILED, str(fault))


def _stop(row: Command) -> Command:
    if row.kind != "estop":
        return _queue_record(row, request_stop(_message(row), row.station.name).result())
    reason, username = str(row.args.get("why", "pressed")), row.user.get_username()
    return _queue_record(
        row, press_estop(station=row.station.name, username=username, why=reason, uuid=row.uuid).result()
    )


def _queue_record(row: Command, answer: Answer) -> Command:
    """Queue the row of a stop that has been carried out already."""
    _put(row, answer)
    notes.record(row)
    return row


def _stored_row(row: Command) -> Command:
    """Store the row of a command, and return the stored row.

    If a row with the same uuid exists, that first row is returned. An answer or a user that the first row lacks is
    copied to it. An e-stop press whose uuid belongs to another command gets its own row.
    """
    _resolve(row)
    try:
        return _merged(row)
    except IntegrityError:  # sent twice concurrently: the other writer has inserted it
        return _merged(row)


def _merged(row: Command) -> Command:
    first = _first_or_own(row)
    if first is None:
        with transaction.atomic():
            row.save(force_insert=True)
        return row
    better = _merged_fields(row, first)
    if better:
        row.save(
            update_fields=better, force_update=True
        )  # force_update: `row` was not loaded, so a plain save() would insert it
    return _find_first(row) or row


def _merged_fields(row: Command, first: Command) -> list[str]:
    """Return the names of the fields of `first` that `row` can fill in or replace.

    `row` is a record of the same stop as `first`, and arrived on another path. The fields of the answer are included in
    three cases: `first` has no answer; only the answer in `row` says that the stop was carried out; or only the answer
    in `row` says that this press latched the stop. The fields `user` and `args` are included if only `row` has a user.
    """
    carried_out = row.status in CARRIED_OUT and first.status not in CARRIED_OUT
    latched = row.data.get("latched") == "anew" and first.data.get("latched") == "before"
    answer = _ANSWER if first.status in _UNANSWERED or carried_out or latched else ()
    origin = ("user", "args") if first.user_id is None and row.user_id is not None else ()
    return [*answer, *origin]


def _first_or_own(row: Command) -> Command | None:
    """Return the row that this command already has in the database; None if it has none.

    The uuid of an e-stop `row` may already belong to another press of the e-stop, or to another command. In this case
    the row gets a new uuid first. The new uuid is derived from the press, so that every writer and every repetition
    finds the same row.
    """
    try:
        first = _find_first(row)
    except Conflict as conflict:
        if row.kind != "estop":
            raise
        repeat = str(conflict)
    else:
        if first is None or not _latched_again(row, first):
            return first
        repeat = "pressed again, or a late copy: this uuid was carried out before"
    user = row.user.get_username() if row.user else ""
    row.data = {**row.data, "sent_uuid": str(row.uuid), "repeat": repeat}
    row.uuid = uuid5(row.uuid, f"{row.station.name} {user} {row.data.get('carried_out_at', '')}")
    return _find_first(row)


def _latched_again(row: Command, first: Command) -> bool:
    """Return True if the press `row` latched the e-stop anew, and not at the same time as `first` did.

    `first` is the press that was recorded first with the same uuid.
    """
    at = first.data.get("carried_out_at")
    return row.data.get("latched") == "anew" and at not in (None, row.data["carried_out_at"])


def _resolve(row: Command) -> None:
    """Load station and user from the database if only their names are known. Raises: NotFound."""
    if row.station_id is None:
        row.station = station_get(name=row.station.name)
    if row.user is not None and row.user_id is None:
        row.user = get_user_model().objects.filter(username=row.user.get_username()).first()


unwritten = UnwrittenCommands(_stored_row)
notes = StopRecorder(lambda row: unwritten.store(row), journal=unwritten.prepare)


def _find_first(row: Command) -> Command | None:
    """Return the existing row with this uuid, None if there is none. Raises: Conflict if it is another command."""
    first = Command.objects.select_related("station", "user").filter(uuid=row.uuid).first()
    if first is None:
        return None
    unverified = row.kind == "estop" and None in (
        first.user_id,
        row.user_id,
    )  # its user is unknown on one of its paths
    same_user = first.user_id == row.user_id or unverified
    if (first.station_id, first.kind) != (row.station_id, row.kind) or not same_user:
        raise Conflict(_UUID_OF_ANOTHER(uuid=row.uuid, first=first))
    return first


def _put(row: Command, answer: Answer) -> None:
    row.status, row.reason = answer.status, answer.reason
    row.allowed, row.data = answer.allowed, answer.data
    row.answered_at = timezone.now()


def _update(row: Command) -> None:
    """Save the answer; if the database refuses, `resolve_unknown_outcome` asks the runtime again later."""
    try:
        row.save(update_fields=_ANSWER)
    except Error as error:
        log.error(
            "the answer to %s %s (%s) is not in the database: %s", row.kind, row.uuid, row.status, error
        )


def _message(
    row: Command, role: str = "", vouched: Sequence[str] = (), valid_until: float = float("inf")
) -> messages.Command:
    """Return the command in the form in which it is sent to the runtime.

    `role` is the user's role. It is "" for stops, which need no role and wait for no database. `vouched` are the names
    of arguments that come from an administrator's table or the lab's records instead of the user. `valid_until` is the
    time on the runtime's clock after which the command is no longer executed.
    """
    return messages.Command(
        str(row.uuid),
        row.kind,
        row.args,
        user=row.user.get_username() if row.user else "",
        holder=row.holder,
        epoch=row.epoch,
        boot=row.boot,
        sequence=row.sequence,
        valid_until=valid_until,
        role=role,
        vouched=list(vouched),
    )


def _patience_s() -> float:
    """Return the time [s] after which no caller waits for an answer any more."""
    return settings.EVA_COMMAND_TIMEOUT_S + 1.0
