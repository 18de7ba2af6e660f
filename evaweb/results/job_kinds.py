"""Job of automatic judges."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from evaweb.accounts.roles import Role
from evaweb.jobs.kinds import JobContext, Queue, job_kind
from evaweb.plans.models import Plan
from evaweb.results.ratings import automatic

_TURN_S = 20.0  # time slice, so that other jobs get their turn
_NAMED = 50  # codes of trials without images in the result


# Other users start it on the page of their own plan.
@job_kind(automatic.KIND, least=lambda args: Role.ADMIN, queue=Queue.GPU)
def judge(work: JobContext) -> Mapping[str, Any]:
    """Show trials of a plan to a judge for a limited time, and enqueue a job for the remaining trials.

    The job has two arguments: `plan`, the id of the plan, and `judge`, the name of the judge.
    """
    plan, name = Plan.objects.get(pk=work.args["plan"]), work.args["judge"]
    until, count = time.monotonic() + _TURN_S, 0
    while automatic.judge_next_trial(plan=plan, name=name):
        count += 1
        work.report_progress(f"{count} trials were shown to {name}")
        if time.monotonic() >= until:
            automatic.enqueue_judging(plan=plan, judge=name)
            break
    waiting, unseen = automatic.unjudged_trials(plan=plan, name=name)
    return {"shown": count, "left": waiting, "without_pictures": unseen[:_NAMED]}
