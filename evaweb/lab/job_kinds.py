"""The job that makes a diagnostic bundle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from django.contrib.auth.models import User

from evaweb.jobs.kinds import JobContext, job_kind
from evaweb.roles import Role

_KEPT = 3  # bundles of a user


@job_kind("diagnose", least=lambda args: Role.ADMIN)
def diagnose(work: JobContext) -> Mapping[str, Any]:
    """A bundle as its user may see it; args: user, name."""
    from evaweb.lab.diagnosis import bundle  # the web knows this kind too, and never does it

    user = User.objects.get(pk=work.args["user"])
    path = bundle.folder(user) / work.args["name"]
    notes = bundle.write(path, bundle.sight_for(user), lambda part: work.report_progress(f"gathering {part}"))
    for old in sorted(path.parent.glob("*.zip"))[:-_KEPT]:
        old.unlink(missing_ok=True)
    return {"bytes": path.stat().st_size, "left_out": len(notes)}
