"""Job that carries out trials of a plan at copies of a simulated station."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evaweb.jobs.kinds import JobContext, Queue, job_kind
from evaweb.plans.copies import JOB, carry_out_some


@job_kind(JOB, queue=Queue.STATION)
def carry_out_trials(work: JobContext) -> Mapping[str, Any]:
    """Carry out the next trials of a plan.

    The job has four arguments: `plan`, `station` and `user` are ids, and `count` is the number of copies.
    """
    return carry_out_some(work.args, work.report_progress)
