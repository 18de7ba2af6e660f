"""Jobs that make a plan from a template, and that carry out trials at copies of a simulated station."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evaweb.jobs.kinds import JobContext, Queue, job_kind
from evaweb.plans.copies import JOB, carry_out_next
from evaweb.plans.models import PlanTemplate
from evaweb.plans.plan_templates import KIND, start_plan
from evaweb.trials.models import Checkpoint


@job_kind(KIND)
def make_plan(work: JobContext) -> Mapping[str, Any]:
    """Make, freeze and start the plan of a new checkpoint; the job's arguments are the ids of `template` and
    `checkpoint`.
    """
    template = PlanTemplate.objects.select_related("plan__owner", "station").get(pk=work.args["template"])
    return start_plan(template, Checkpoint.objects.get(pk=work.args["checkpoint"]))


@job_kind(JOB, queue=Queue.COPIES, start="on its plan's page")
def carry_out_trials(work: JobContext) -> Mapping[str, Any]:
    """Carry out the next trial of a plan, until none is left.

    Arguments of the job: `plan`, `station` and `user` are ids, `copy` is the number of this one of `count` copies,
    `first` the number of the last handout before they began, and `most` how many trials all of them begin, None for
    all.
    """
    return carry_out_next(work)
