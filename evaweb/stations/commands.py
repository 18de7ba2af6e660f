"""Commands: who gave which, and what became of it.

A row first, then the wire, then the answer. The stopping commands go to the wire first and wait for no database.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from datetime import timedelta
from typing import Any
from uuid import UUID, uuid4

from django.conf import settings
from django.contrib.auth import get_user_model
from django.db import Error, IntegrityError, transaction
from django.utils import timezone

from evaweb.errors import Conflict, EvaError, StationGone
from evaweb.frames import plain
from evaweb.lock_wait import lock_wait
from evaweb.roles import Role, require
from evaweb.stations.holders import holder_of
from evaweb.stations.models import Command, CommandStatus, Station
from evaweb.stations.selectors import station_get
from evaweb.stations.stops import Answer, answer_of, estop, spoken, stopped
from evaweb.stations.unwritten import Unwritten
from evaweb.stations.wire import NoAnswer, wire_to
from runtime import messages
from runtime.bus import CodecError

log = logging.getLogger(__name__)
STOPPING = ("stop", "halt", "estop")  # never stale; the runtime has the same list
COLLECTING = ("arm", "disarm", "label", "discard")
KINDS = (
    *("setup", "run", "stop", "halt", "resume", "home", "release", "record_start", "record_stop", "estop"),
    *("tune", "step", "commit", "cancel", "move", "gripper", "approach"),
    *COLLECTING,
)
_UNANSWERED = (CommandStatus.PRESSED, CommandStatus.UNKNOWN)
_ANSWER = ("status", "reason", "allowed", "data", "answered_at")
_NOTE_S = 0.5  # for which the answer to a stopping command is kept by its row; then the row is written later
_LONG_AGO = 0.0  # on the runtime's clock: a command that must not be carried out any more


class NotSent(EvaError):
    """The command was not sent, because it could not be written down."""

    status = 503


def identity_of(given: UUID | str | None) -> UUID:
    """The uuid of a command, a new one where none is given; EvaError where it is none."""
    if given is None:
        return uuid4()
    try:
        return UUID(str(given))
    except ValueError:
        raise EvaError(f"uuid {given!r:.60}: must be a UUID such as {uuid4()}") from None


def issue(
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
) -> Command:
    """Give a command and return its row with the answer; the same uuid again returns the first one's.

    `boot` and `sequence` are those of the snapshot that the page showed. Never call it within a transaction:
    nobody else could write until the station has answered. Raises NotAllowed, Conflict for a uuid that is
    another command's, NotSent where the database does not take the row.
    """
    row = Command(
        uuid=identity_of(uuid),
        station=station,
        user=user,
        kind=kind,
        args=plain(dict(args or {})),
        holder=holder_of(user.get_username(), page),
        epoch=epoch,
        boot=boot,
        sequence=sequence,
    )
    if kind not in KINDS:
        raise EvaError(f"command {kind!r:.40} is unknown; allowed: {', '.join(KINDS)}")
    if kind != "estop":
        require(user, Role.OPERATOR)
    return _stop(row) if kind in STOPPING else _give(row)


def estop_noted(*, user: Any, station: Station, why: str, uuid: UUID | str, answer: Answer) -> Command:
    """The row of an e-stop that was pressed; of `station` the name is enough, where the database does not say more."""
    row = Command(uuid=identity_of(uuid), station=station, user=user, kind="estop", args={"why": spoken(why)})
    return _noted(row, answer)


def stop_noted(
    *, user: Any, station: Station, kind: str, page: str, epoch: int, uuid: UUID | str, answer: Answer
) -> Command:
    """The row of a stop or halt that was given."""
    holder = holder_of(user.get_username(), page)
    row = Command(uuid=identity_of(uuid), station=station, user=user, kind=kind, holder=holder, epoch=epoch)
    return _noted(row, answer)


def settle(*, row: Command) -> Command:
    """Find out what became of a command whose answer was lost; leaves it as it is where nobody can know yet.

    The runtime answers a uuid that it knows as it did the first time. One that it does not know comes too
    late now, is refused, and is remembered as refused: it can never be carried out any more. A stopping
    command never comes too late, and is therefore not asked about.
    """
    age = timezone.now() - row.issued_at
    if row.kind in STOPPING or row.status not in _UNANSWERED or age < timedelta(seconds=_patience_s()):
        return row
    try:
        answer = answer_of(wire_to(row.station.name).request(_message(row, valid_until=_LONG_AGO)))
    except StationGone:
        return row
    _put(row, answer)
    _update(row)
    return row


def run_unopened(*, station: Station, uuid: UUID | str, reason: str) -> None:
    """Keep of an accepted run that its recording could not be opened: its answer may be heard of later still."""
    Command.objects.filter(pk=identity_of(uuid), station=station, kind="run").update(unopened=reason)


def unsettled(*, station: Station) -> list[Command]:
    """The commands of the last hour whose answers were lost."""
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


def _give(row: Command) -> Command:
    first = _first(row)
    if first is not None:
        return settle(row=first)
    _require_sendable(row)
    pressed = time.monotonic()
    try:
        with transaction.atomic(durable=True):
            row.issued_at = timezone.now()
            row.save(force_insert=True)
    except IntegrityError:  # pressed twice in the same moment
        first = _first(row)
        if first is None:
            raise
        return first
    except Error as error:
        raise NotSent(
            f"{row.kind} was not sent: the database does not take it now ({error}); stopping works"
        ) from error
    _put(row, _asked(row, waited=time.monotonic() - pressed))
    _update(row)
    return row


def _require_sendable(row: Command) -> None:
    """Before it is a row that would be asked about for an hour."""
    try:
        messages.encode(_message(row))
    except CodecError as error:
        raise EvaError(f"{row.kind} cannot be sent with these args: {error}") from None


def _asked(row: Command, waited: float) -> Answer:
    """What the runtime says to a command whose row took `waited` seconds to be written."""
    if waited > settings.EVA_COMMAND_TIMEOUT_S:
        late = f"not sent: the database took {waited:.0f} s to write it down; look at the robot, press again"
        return Answer(CommandStatus.FAILED, late)
    try:
        return answer_of(wire_to(row.station.name).request(_message(row), expires=True))
    except NoAnswer as fault:
        return Answer(CommandStatus.UNKNOWN, str(fault))
    except StationGone as fault:
        return Answer(CommandStatus.FAILED, str(fault))


def _stop(row: Command) -> Command:
    if row.kind == "estop":
        why, username = str(row.args.get("why", "pressed")), row.user.get_username()
        return _noted(row, estop(station=row.station.name, username=username, why=why, uuid=row.uuid))
    return _noted(row, stopped(_message(row), row.station.name))


def _noted(row: Command, answer: Answer) -> Command:
    """Write down what has been done already, whenever the database takes it."""
    _put(row, answer)
    try:
        with lock_wait(_NOTE_S):
            return _written(row)
    except Error as error:
        log.warning("%s (%s) is written down later: %s", row, row.uuid, error)
        unwritten.keep(row)
        return row


def _written(row: Command) -> Command:
    """The row as it is in the database: this one, or the first of that uuid."""
    _resolve(row)
    try:
        first = _first(row)
        if first is None:
            with transaction.atomic():
                row.save(force_insert=True)
        elif first.status in _UNANSWERED:
            row.save(
                update_fields=_ANSWER, force_update=True
            )  # not the object that was read: it would be inserted
        else:
            return first
    except IntegrityError:  # pressed twice in the same moment: the other one has written it
        return _first(row) or row
    return row


def _resolve(row: Command) -> None:
    """Station and user as the database has them, where they are known by name alone; NotFound."""
    if row.station_id is None:
        row.station = station_get(name=row.station.name)
    if row.user is not None and row.user_id is None:
        row.user = get_user_model().objects.filter(username=row.user.get_username()).first()


unwritten = Unwritten(_written)


def _first(row: Command) -> Command | None:
    """The row that has this uuid already; raises Conflict where it is another command."""
    first = Command.objects.select_related("station", "user").filter(uuid=row.uuid).first()
    if first and (first.station_id, first.user_id, first.kind) != (row.station_id, row.user_id, row.kind):
        raise Conflict(f"uuid {row.uuid} is that of another command ({first}); each needs one of its own")
    return first


def _put(row: Command, answer: Answer) -> None:
    row.status, row.reason = answer.status, answer.reason
    row.allowed, row.data = answer.allowed, answer.data
    row.answered_at = timezone.now()


def _update(row: Command) -> None:
    """Where the database refuses, `settle` asks the runtime again later."""
    try:
        row.save(update_fields=_ANSWER)
    except Error as error:
        log.error(
            "the answer to %s %s (%s) is not in the database: %s", row.kind, row.uuid, row.status, error
        )


def _message(row: Command, valid_until: float = float("inf")) -> messages.Command:
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
    )


def _patience_s() -> float:
    """After this time nobody waits for an answer any more [s]."""
    return settings.EVA_COMMAND_TIMEOUT_S + 1.0
