"""Job of a preflight whose station is not running."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evaweb.jobs.kinds import JobContext, Queue, job_kind
from evaweb.preflights.models import Preflight, PreflightStatus
from evaweb.preflights.selectors import preflight_get
from evaweb.preflights.services import finish_preflight

LONGEST_S = 3600.0


@job_kind("preflight", queue=Queue.STATION, folder=False)
def preflight(work: JobContext) -> Mapping[str, Any]:
    """Query the checkpoint's server, as described in the station's deployment file.

    The job has one argument: `preflight`, the id of the preflight.
    """
    row: Preflight = preflight_get(id=work.args["preflight"])
    from runtime.station.preflight_child import (
        run_preflight,
    )  # imported late: web processes import this module but never run the job

    if row.status != PreflightStatus.RUNNING:
        return {"verdict": row.verdict}
    work.report_progress(f"asking the server of {row.checkpoint}")
    request = {"deployment": row.station.deployment, "changes": row.changes}
    return {"verdict": finish_preflight(row=row, report=run_preflight(request, LONGEST_S)).verdict}
