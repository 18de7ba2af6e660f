"""The job of automatic judges."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from evaweb.jobs.kinds import JobContext, Queue, job_kind
from evaweb.plans.models import Plan
from evaweb.results.ratings import automatic
from evaweb.roles import Role

_TURN_S = 20.0  # then what else waits has its turn
_NAMED = 50  # codes of trials without pictures


# Others ask on the page of a plan of theirs.
@job_kind(automatic.KIND, least=lambda args: Role.ADMIN, queue=Queue.GPU)
def judge(work: JobContext) -> Mapping[str, Any]:
    """Show trials of a plan to a judge, and ask for the rest; args: plan, judge."""
    plan, name = Plan.objects.get(pk=work.args["plan"]), work.args["judge"]
    until, shown = time.monotonic() + _TURN_S, 0
    while automatic.judge_next_trial(plan=plan, name=name):
        shown += 1
        work.report_progress(f"{shown} trials were shown to {name}")
        if time.monotonic() >= until:
            automatic.enqueue_judging(plan=plan, judge=name)
            break
    waiting, unseen = automatic.unjudged_trials(plan=plan, name=name)
    return {"shown": shown, "left": waiting, "without_pictures": unseen[:_NAMED]}
