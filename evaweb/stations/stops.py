"""Stop, halt and e-stop: sent directly to the station, without the database.

`press_estop` and `request_stop` never block: requests run in threads per station. While an equal request to the station
is pending, a new one does not get a thread of its own, see `request_coalescer`.
"""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from uuid import UUID

from django.conf import settings

from evaweb.core.binary_frames import to_json_value
from evaweb.core.errors import StationGone
from evaweb.stations.lease_holders import holder_of, with_display_names
from evaweb.stations.models import CommandStatus
from evaweb.stations.request_coalescer import RequestCoalescer, TooManyRequests
from evaweb.stations.runtime_client import NoAnswer, connection_to
from runtime.core.sentences import Pattern
from runtime.ipc import estop_requests as pressing
from runtime.ipc import messages

_E_STOP_GOES_ANOTHER_WAY = Pattern(
    "stations.stops.e_stop_goes_another_way",
    "{fault}; the e-stop goes another way",
)

HARDWARE_STOP = "USE THE HARDWARE STOP"
UNKNOWN_STOPPER = Pattern(
    "stations.stops.unknown_stopper",
    "{why}: who may stop is not known; the e-stop works",
)
_STOP_BY_HAND = Pattern("stations.stops.by_hand", "USE THE HARDWARE STOP: {why}")
_ANOTHER_ANSWERED = Pattern(
    "stations.stops.another_answered",
    "the station {other} answered instead of {station}, and was stopped",
)
_VIEWER = Pattern(
    "stations.stops.viewer",
    "{user} is a viewer; this needs an operator: ask an administrator, or press the e-stop",
)
_ESTOP_S = 1.0  # longest wait for the answer to an e-stop before the page turns red
_MOST_STOPS = 32  # concurrent stops of different leases at one station


@dataclass(frozen=True, slots=True)
class Answer:
    """Answer to a command; `allowed` lists the commands that would be accepted now.

    `uuid` is that of the e-stop press that was answered, possibly a concurrent one.
    """

    status: CommandStatus
    reason: str = ""
    allowed: list[str] = field(default_factory=list)
    data: dict[str, Any] = field(default_factory=dict)
    uuid: str = ""


def answer_of(ack: messages.Ack) -> Answer:
    """Return the runtime's answer as JSON-compatible objects, with user names for holders."""
    return Answer(
        CommandStatus(ack.status), with_display_names(ack.reason), list(ack.allowed), to_json_value(ack.data)
    )


def clean_reason(why: str) -> str:
    """Return the reason truncated and without characters that cannot be sent or stored: no press fails for its text."""
    return pressing.sanitize_text(why)


_presses: RequestCoalescer[Answer] = RequestCoalescer("e-stop")
_stops: RequestCoalescer[Answer] = RequestCoalescer("stop", _MOST_STOPS)


def press_estop(*, station: str, username: str, why: str, uuid: UUID | str) -> Future[Answer]:
    """Press the e-stop of a station and return the future of the answer.

    If another press is in progress, the future has the answer to that press; this press is sent nevertheless.
    """
    work = partial(send_estop, station=station, username=username, why=why, uuid=uuid)
    return _presses.submit(station, work, identity=str(uuid), shared=True)


def request_stop(command: messages.Command, station: str) -> Future[Answer]:
    """Send a stop or halt and return the future of the station's answer.

    While a request of the same kind and lease is pending at the station, a call with the uuid of that request shares
    the answer to it. All calls with other uuids are combined into one further request, which is sent afterwards.
    """
    key = (command.kind, command.holder, command.epoch)
    try:
        return _stops.submit(station, partial(send_stop, command, station), key=key, identity=command.uuid)
    except TooManyRequests as fault:
        answer: Future[Answer] = Future()
        answer.set_result(Answer(CommandStatus.FAILED, _E_STOP_GOES_ANOTHER_WAY(fault=fault)))
        return answer


def refused_to_a_viewer(username: str) -> str:
    """Return the message for a viewer whose stop or halt is refused."""
    return _VIEWER(user=username)


def send_estop(*, station: str, username: str, why: str, uuid: UUID | str) -> Answer:
    """Press the e-stop of the station and wait for the answer; for any user, without the database."""
    command = messages.Command(str(uuid), "estop", {"why": clean_reason(why)}, user=username, holder=username)
    try:
        ack = connection_to(station).request_urgent(command, "guard", "estop", _estop_s())
        answer = replace(answer_of(ack), uuid=str(uuid))
        answering = answer.data.get("station", station)
        if answering != station:  # another station reuses the socket address of this one, which was killed
            reason = _STOP_BY_HAND(why=_ANOTHER_ANSWERED(other=answering, station=station))
            return Answer(CommandStatus.FAILED, reason, [], answer.data)
    except NoAnswer as fault:
        answer = Answer(CommandStatus.UNKNOWN, _STOP_BY_HAND(why=fault))
    except StationGone as fault:
        answer = Answer(CommandStatus.FAILED, _STOP_BY_HAND(why=fault))
    if answer.status is CommandStatus.REFUSED:
        reason = _STOP_BY_HAND(why=answer.reason)
        return Answer(CommandStatus.FAILED, reason, answer.allowed, answer.data)
    return answer


def stop_command(*, kind: str, username: str, page: str, epoch: int, uuid: UUID | str) -> messages.Command:
    """Return the message of a stop or halt; the runtime itself checks the lease."""
    holder = holder_of(username, page)
    return messages.Command(str(uuid), kind, user=username, holder=holder, epoch=epoch)


def send_stop(command: messages.Command, station: str) -> Answer:
    """Send a stop or halt over a new connection and return the answer, so that no hanging request delays it."""
    try:
        timeout = settings.EVA_COMMAND_TIMEOUT_S
        return answer_of(connection_to(station).request_urgent(command, "coordinator", "commands", timeout))
    except NoAnswer as fault:
        return Answer(CommandStatus.UNKNOWN, _E_STOP_GOES_ANOTHER_WAY(fault=fault))
    except StationGone as fault:
        return Answer(CommandStatus.FAILED, str(fault))


def _estop_s() -> float:
    return min(_ESTOP_S, settings.EVA_COMMAND_TIMEOUT_S)
