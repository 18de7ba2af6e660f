"""Stop, halt and e-stop: straight to the station, without the database; and what a station's answer comes to."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any
from uuid import UUID

from django.conf import settings

from evaweb.errors import StationGone
from evaweb.frames import plain
from evaweb.stations.holders import holder_of, readable
from evaweb.stations.models import CommandStatus
from evaweb.stations.wire import NoAnswer, wire_to
from runtime import messages

HARDWARE_STOP = "USE THE HARDWARE STOP"
_ESTOP_S = 1.0  # what a person waits for before the page turns red
_LONGEST_WHY = 240  # characters


@dataclass(frozen=True, slots=True)
class Answer:
    """What became of a command; `allowed` names the commands that would be accepted now."""

    status: CommandStatus
    reason: str = ""
    allowed: list[str] = field(default_factory=list)
    data: dict[str, Any] = field(default_factory=dict)


def answer_of(ack: messages.Ack) -> Answer:
    """The runtime's answer with people's names, as JSON may carry it."""
    return Answer(CommandStatus(ack.status), readable(ack.reason), list(ack.allowed), plain(ack.data))


def spoken(why: str) -> str:
    """The beginning of it, with nothing in it that cannot be sent or kept: no press is lost for its words."""
    return why[:_LONGEST_WHY].encode("utf-8", "replace").decode().replace("\x00", "")


def estop(*, station: str, username: str, why: str, uuid: UUID | str) -> Answer:
    """Press the e-stop of the station of that name; for any user, and without the database."""
    command = messages.Command(str(uuid), "estop", {"why": spoken(why)}, user=username, holder=username)
    try:
        answer = answer_of(wire_to(station).urgent(command, "guard", "estop", _estop_s()))
        said = answer.data.get("station", station)
        if said != station:  # its socket is where another station's was before that one was killed
            reason = f"the station {said} answered instead of {station}, and was stopped"
            return Answer(CommandStatus.FAILED, f"{HARDWARE_STOP}: {reason}", [], answer.data)
    except NoAnswer as fault:
        answer = Answer(CommandStatus.UNKNOWN, f"{HARDWARE_STOP}: {fault}")
    except StationGone as fault:
        answer = Answer(CommandStatus.FAILED, f"{HARDWARE_STOP}: {fault}")
    if answer.status is CommandStatus.REFUSED:
        return Answer(CommandStatus.FAILED, f"{HARDWARE_STOP}: {answer.reason}", answer.allowed, answer.data)
    return answer


def stop(*, kind: str, station: str, username: str, page: str, epoch: int, uuid: UUID | str) -> Answer:
    """Stop or halt, without the database: the runtime itself knows who has the lease."""
    holder = holder_of(username, page)
    command = messages.Command(str(uuid), kind, user=username, holder=holder, epoch=epoch)
    return stopped(command, station)


def stopped(command: messages.Command, station: str) -> Answer:
    """What the station says to a stop or halt; nothing that hangs stands before it."""
    try:
        timeout = settings.EVA_COMMAND_TIMEOUT_S
        return answer_of(wire_to(station).urgent(command, "main", "commands", timeout))
    except NoAnswer as fault:
        return Answer(CommandStatus.UNKNOWN, f"{fault}; the e-stop goes another way")
    except StationGone as fault:
        return Answer(CommandStatus.FAILED, str(fault))


def _estop_s() -> float:
    return min(_ESTOP_S, settings.EVA_COMMAND_TIMEOUT_S)
