"""Job that creates a diagnostic bundle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from django.contrib.auth.models import User

from evaweb.accounts.roles import Role
from evaweb.jobs.kinds import JobContext, job_kind

_KEPT = 3  # bundles per user


@job_kind("diagnose", least=lambda args: Role.ADMIN)
def diagnose(work: JobContext) -> Mapping[str, Any]:
    """Write a diagnostic bundle that contains what the user may see.

    The job has two arguments: `user`, the id of the account, and `name`, the file name of the bundle.
    """
    from evaweb.lab.diagnosis import (
        bundle,
    )  # imported here: the web knows this kind of job too, but never runs it

    user = User.objects.get(pk=work.args["user"])
    path = bundle.folder(user) / work.args["name"]
    notes = bundle.write(
        path, bundle.visibility_for(user), lambda part: work.report_progress(f"gathering {part}")
    )
    for old in sorted(path.parent.glob("*.zip"))[:-_KEPT]:
        old.unlink(missing_ok=True)
    return {"bytes": path.stat().st_size, "left_out": len(notes)}
