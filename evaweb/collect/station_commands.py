"""Commands of a session: arguments of its set-up and runs, and effects of an accepted run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from uuid import UUID

from django.db import transaction

from evaweb.accounts.roles import Role, require_role
from evaweb.collect.models import CollectSession
from evaweb.collect.selectors import session_get
from evaweb.collect.setups import require_same_setup, setup_from_snapshot
from evaweb.collect.station_events import bind_demonstration
from evaweb.core.errors import Conflict, EvaError
from evaweb.episodes.services import record_opened
from evaweb.stations.commands import issue_command, parse_command_uuid
from evaweb.stations.models import CARRIED_OUT, Command
from evaweb.stations.runtime_client import connection_to
from runtime.core.sentences import Pattern

_ARGS_SAY_BESIDE_SESSION_WHICH = Pattern(
    "collect.station_commands.args_say_beside_session_which",
    "args say {doubled} beside the session, which has its own: leave it out",
)
_TAKES_NO_SESSION_ALLOWED_SETUP = Pattern(
    "collect.station_commands.takes_no_session_allowed_setup",
    "{kind} takes no session; allowed: setup, run",
)
_SESSION_CLOSED_RESUME_FIRST = Pattern(
    "collect.station_commands.session_closed_resume_first",
    "session {session} is closed: resume it first",
)


def session_command(
    *,
    user: Any,
    session: CollectSession,
    kind: str,
    uuid: UUID | str | None = None,
    args: Mapping[str, Any] | None = None,
    **given: Any,
) -> Command:
    """Send a command for a session.

    The commands `setup` and `run` get task and session from `session`; `given` are further arguments of
    `issue_command`. Before each run the station's set-up is compared with the session's. After an accepted run, the
    database has a row for its episode. Never call this within a transaction.

    Raises: SetupChanged if the set-ups differ.
    """
    require_role(user, Role.OPERATOR)
    identity = parse_command_uuid(uuid)
    own = _own(session, kind, user)
    further = dict(args or {})
    doubled = sorted(own.keys() & further.keys())
    if doubled:
        raise EvaError(_ARGS_SAY_BESIDE_SESSION_WHICH(doubled=", ".join(doubled)))
    if not Command.objects.filter(pk=identity).exists():  # a repeated uuid only asks for the outcome
        _require_fit(session, kind)
    row = issue_command(
        user=user, station=session.station, kind=kind, args={**further, **own}, uuid=identity, **given
    )
    if kind == "run" and row.status in CARRIED_OUT and row.data.get("episode"):
        _begun(session, row, user.get_username())
    return row


@transaction.atomic
def _begun(session: CollectSession, row: Command, operator: str) -> None:
    """Create the row of the run's episode, unless the station has reported that it could not be opened."""
    if Command.objects.select_for_update().get(pk=row.pk).unopened:
        return
    episode = record_opened(
        station=session.station,
        uuid=row.data["episode"],
        kind="demonstration",
        mode="collect",
        task=session.task,
        operator=operator,
    )
    bind_demonstration(episode=episode, session=session)


def _own(session: CollectSession, kind: str, user: Any) -> dict[str, Any]:
    if kind == "setup":
        return {"collect": True, "task": session.task}
    if kind == "run":
        return {
            "mode": "collect",
            "task": session.task,
            "operator": user.get_username(),
            "session": {"uuid": str(session.pk), "dataset": session.dataset},
        }
    raise EvaError(_TAKES_NO_SESSION_ALLOWED_SETUP(kind=kind))


def _require_fit(session: CollectSession, kind: str) -> None:
    """Raise Conflict if the session is closed; before a run also if the station's set-up has changed."""
    if session_get(uuid=session.pk).closed_at is not None:
        raise Conflict(_SESSION_CLOSED_RESUME_FIRST(session=session))
    if kind == "run":
        station = session.station.name
        require_same_setup(
            setup_from_snapshot(connection_to(station).status(), station), session.setup, f"session {session}"
        )
