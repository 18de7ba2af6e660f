"""Services for preflights.

A preflight is run by its station, or by a worker with the station's deployment file if the station is not running. The
station's process has the keys, the tunnels and the deployment, and reaches the server the way a run would. It runs one
preflight at a time, never during other work, and stores the report until it is fetched.
"""

from __future__ import annotations

import logging
from datetime import timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

from django.db import transaction
from django.utils import timezone

from evaweb.accounts.roles import Role, require_role, role_of
from evaweb.blinding.visibility import visibility_for_user
from evaweb.core.binary_frames import to_json_value
from evaweb.core.errors import Conflict, StationGone
from evaweb.jobs.models import JobStatus
from evaweb.jobs.selectors import job_newest
from evaweb.jobs.services import enqueue
from evaweb.jobs.workers import waiting_for
from evaweb.preflights.models import Preflight, PreflightStatus
from evaweb.stations.commands import TABLES
from evaweb.stations.models import Station
from evaweb.stations.runtime_client import NoAnswer, connection_to
from evaweb.stations.selectors import station_list
from evaweb.trials.models import Checkpoint
from runtime.config import loader as deployment
from runtime.config.loader import ConfigurationError, server_address
from runtime.core.sentences import Pattern, fixed
from runtime.ipc.messages import Command
from runtime.ipc.session_state import complete_state_meaning

log = logging.getLogger(__name__)
_NO_STATION_FREE_NONE_HAS = fixed(
    "preflights.services.no_station_free_none_has",
    "no station is free, and none has a deployment file for the worker: start a station, or wait for one",
)
_BLIND_TRIAL_UNDER_WAY = Pattern(
    "preflights.services.blind_trial_under_way",
    "{stations}: a blind trial is under way there, and its policy server is hidden from you; ask when it is scored",
)
_WITH_SAME_POLICY_SERVER_PREFLIGHT = Pattern(
    "preflights.services.with_same_policy_server_preflight",
    "{other} is {label} with the same policy server: a preflight would disturb it; wait until its run "
    "is over",
)
_DEPLOYMENT_FILE_NOT_KNOWN_HERE = Pattern(
    "preflights.services.deployment_file_not_known_here",
    "{gone}; its deployment file is not known here, so the worker cannot ask in its place",
)
_LOOK_S = 0.5  # longest wait for another station's report on its server
_UNTOLD = timedelta(hours=1)  # time limit of a preflight without a known duration


def start_preflight(*, user: Any, checkpoint: Checkpoint, station: Station | None = None) -> Preflight:
    """Start a preflight with the deployment of `station` (None: the first suitable one) and return its row.

    Never call it within a transaction.

    Raises:
        NotAllowed: The user is not an operator.
        Conflict: The station or the server is busy, or a blind trial is running.
        StationGone: The station is not running and its deployment file is unknown.
    """
    require_role(user, Role.OPERATOR)
    if hidden := sorted(
        visibility_for_user(user).busy_stations
    ):  # for any server, as its response would reveal the one in use
        raise Conflict(_BLIND_TRIAL_UNDER_WAY(stations=", ".join(hidden)))
    chosen = station or _first_station()
    row = Preflight(checkpoint=checkpoint, station=chosen, user=user, policy=checkpoint.policy)
    try:
        server = _server_of_station(chosen, checkpoint)
    except NoAnswer:
        raise
    except StationGone as gone:
        return _start_by_worker(row, gone)
    _require_free(server, chosen)
    return _start_at_station(row)


def refresh_preflight(*, row: Preflight) -> Preflight:
    """Update the row of a running preflight from its station or job; unchanged while the result is unknown."""
    if row.status != PreflightStatus.RUNNING:
        return row
    if row.by == Preflight.By.WORKER:
        return _settled_by_job(row)
    try:
        ack = connection_to(row.station.name).request(
            Command(str(uuid4()), "preflight_report", {"id": str(row.pk)}), timeout=_LOOK_S
        )
    except NoAnswer:
        return _overdue(row, f"{row.station.name} has not answered since")
    except StationGone as gone:
        return finish_preflight(row=row, reason=str(gone))
    if ack.status != "done":
        return finish_preflight(row=row, reason=f"{row.station.name} was restarted meanwhile: ask again")
    status = to_json_value(ack.data)
    if status["running"]:
        return _overdue(row, "it did not end in time")
    return finish_preflight(row=row, report=status["report"], reason=status["failure"])


def refresh_preflights(*, station: Station) -> int:
    """Update the running preflights of a station; return the number of finished ones."""
    rows = Preflight.objects.filter(station=station, status=PreflightStatus.RUNNING)
    settled = [refresh_preflight(row=row) for row in rows.select_related("station", "checkpoint")]
    return sum(row.status != PreflightStatus.RUNNING for row in settled)


def finish_preflight(*, row: Preflight, report: dict[str, Any] | None = None, reason: str = "") -> Preflight:
    """Store the report, or the reason for which there is no report; only the first result counts."""
    status = PreflightStatus.LOST if report is None else PreflightStatus.DONE
    facts = {
        "status": status,
        "report": report,
        "reason": "" if report else reason,
        "ended_at": timezone.now(),
    }
    Preflight.objects.filter(pk=row.pk, status=PreflightStatus.RUNNING).update(**facts)
    row.refresh_from_db()
    return row


def _first_station() -> Station:
    """Return the first station that runs and is idle, else the first with a known deployment."""
    stations = list(station_list())
    for station in stations:
        try:
            if not connection_to(station.name).status(timeout=_LOOK_S)["state_is"]["at_work"]:
                return station
        except StationGone:
            continue
    first = next((station for station in stations if station.deployment), None)
    if first is None:
        raise Conflict(_NO_STATION_FREE_NONE_HAS)
    return first


def _server_of_station(station: Station, checkpoint: Checkpoint) -> str:
    """Return the server that a preflight at the station would query; "" if the checkpoint's policy table is invalid.

    An invalid table is no error here, because the report of the preflight explains it.
    """
    args = {"policy": checkpoint.policy}
    command = Command(str(uuid4()), "policy_server", args, role=Role.OPERATOR, vouched=list(TABLES))
    ack = connection_to(station.name).request(command)
    return str(ack.data["server"]) if ack.status == "done" else ""


def _require_free(server: str, besides: Station) -> None:
    """Raise Conflict if another station is using the server, because answers could be late or mixed up."""
    if not server:
        return
    for station in station_list(all_of_them=True).exclude(pk=besides.pk):
        try:
            ack = connection_to(station.name).request(Command(str(uuid4()), "policy_server"), timeout=_LOOK_S)
        except StationGone:
            continue
        if ack.data.get("server") != server:
            continue
        state_is = complete_state_meaning(ack.data)["state_is"]
        if state_is["at_work"]:
            raise Conflict(_WITH_SAME_POLICY_SERVER_PREFLIGHT(other=station, label=state_is["label"]))


def _start_at_station(row: Preflight) -> Preflight:
    """Start the preflight at the station; the row is written first, so that nothing runs unrecorded."""
    row.by = Preflight.By.STATION
    row.save(force_insert=True)
    checkpoint = {"id": row.checkpoint_id, "name": row.checkpoint.name}
    args = {"id": str(row.pk), **row.changes, "checkpoint": checkpoint}
    username = row.user.get_username() if row.user else ""
    person = {"user": username, "holder": username, "role": role_of(row.user) if row.user else ""}
    command = Command(str(uuid4()), "preflight", args, vouched=list(TABLES), **person)
    try:
        ack = connection_to(row.station.name).request(command)
    except NoAnswer:
        return row  # it may have started: the next refresh finds out
    except StationGone:
        row.delete()
        raise
    if ack.status != "done":
        row.delete()
        raise Conflict(ack.reason)
    row.over_by = timezone.now() + timedelta(seconds=float(ack.data["longest_s"]))
    Preflight.objects.filter(pk=row.pk).update(over_by=row.over_by)
    return row


def _start_by_worker(row: Preflight, gone: StationGone) -> Preflight:
    """Queue the preflight for a worker, with the deployment file of the station that is not running."""
    file = row.station.deployment
    if not file:
        raise StationGone(_DEPLOYMENT_FILE_NOT_KNOWN_HERE(gone=gone))
    try:
        resolved = deployment.apply_changes(deployment.load(Path(file)), row.changes, "the checkpoint")
        _require_free(server_address(resolved.deployment), row.station)
    except ConfigurationError as error:
        log.info("%s: %s", row, error)  # the report will contain it
    row.by = Preflight.By.WORKER
    with transaction.atomic():
        row.save(force_insert=True)
        enqueue(kind="preflight", key=_key(row), args={"preflight": str(row.pk)})
    return row


def _settled_by_job(row: Preflight) -> Preflight:
    job = job_newest(key=_key(row))
    if job is None:
        return finish_preflight(row=row, reason="its job is gone: ask again")
    if job.status == JobStatus.FAILED:
        return finish_preflight(row=row, reason=job.error)
    return _overdue(row, waiting_for(job) or "no worker has done it: does one hang?")


def lacks(*, row: Preflight) -> str:
    """Return why no running worker can execute a queued preflight; "" if one can or a station runs it."""
    if (row.status, row.by) != (PreflightStatus.RUNNING, Preflight.By.WORKER):
        return ""
    job = job_newest(key=_key(row))
    return waiting_for(job) if job is not None else ""


def _overdue(row: Preflight, reason: str) -> Preflight:
    over_by = row.over_by or row.asked_at + _UNTOLD
    return finish_preflight(row=row, reason=reason) if timezone.now() > over_by else row


def _key(row: Preflight) -> str:
    return f"preflight:{row.pk}"
