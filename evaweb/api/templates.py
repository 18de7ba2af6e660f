"""Registration of a checkpoint by a program, such as the end of a training run, which gets a plan by a template."""

from __future__ import annotations

from typing import Annotated, Any

from django.http import HttpRequest
from ninja import Field, Router, Schema, Status

from evaweb.api.responses import FAILURES, Body
from evaweb.plans.plan_templates import register_checkpoint, template_get

router = Router(tags=["checkpoints"])


class NewCheckpoint(Body):
    """Checkpoint to register. `training_run` is the address of the page where its training is recorded."""

    name: Annotated[str, Field(min_length=1, max_length=120)]
    description: Annotated[str, Field(max_length=10_000)] = ""
    digest: Annotated[str, Field(max_length=128)] = ""
    recipe: Annotated[str, Field(max_length=120)] = ""
    training_run: Annotated[str, Field(max_length=500)] = ""


class Registered(Schema):
    """Name of the checkpoint, and id of the job that makes its plan."""

    checkpoint: str
    job: int


@router.post(
    "/{name}/checkpoints",
    response={202: Registered, **FAILURES},
    summary="Register a checkpoint",
    url_name="template-checkpoints",
)
def register(request: HttpRequest, name: str, given: NewCheckpoint) -> Any:
    """Register a checkpoint, whose policy is reached as the template says, and have a plan made for it.

    A job makes and freezes the plan and, if the template has a simulated station, starts its trials. For operators. A
    repetition changes nothing.
    """
    user: Any = request.user
    checkpoint, job = register_checkpoint(user=user, template=template_get(name=name), **given.dict())
    return Status(202, {"checkpoint": checkpoint.name, "job": job.pk})
