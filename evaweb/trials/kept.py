"""What the disk keeps of a trial, read back: the `trial` of a manifest, and the lines of a scores file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, TypeVar
from uuid import UUID

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, StrictBool, ValidationError

from evaweb.errors import EvaError
from evaweb.trials.models import Evaluation, Score

Name = Annotated[str, Field(min_length=1, max_length=120)]
Person = Annotated[str, Field(min_length=1, max_length=150)]
_Count = Annotated[int, Field(ge=0, lt=2**31)]
_Small = Annotated[int, Field(ge=0, lt=2**15)]
_Seconds = Annotated[float, Field(allow_inf_nan=False)]


class Kept(BaseModel):
    """Plain JSON that was written by this program; fields that it does not know are left alone."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class KeptTrial(Kept):
    """A trial as evaweb.trials.facts writes it; what its run adds is absent from a manifest."""

    uuid: UUID
    id: Annotated[int, Field(gt=0, lt=2**63)] | None = None
    evaluation: Name
    evaluation_kind: Evaluation.Kind = Evaluation.Kind.OPEN_BENCH
    version: _Count
    checkpoint: Name
    scene: Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[-\w]+$")]
    position: _Small
    number: _Count
    attempt: _Small
    seed: _Count | None = None
    strategy: dict[str, Any] | None = None
    instruction: str
    time_limit_s: _Seconds | None = None
    station: Annotated[str, Field(min_length=1, max_length=63)]
    simulated: StrictBool = False
    operator: Annotated[str, Field(max_length=150)] = ""
    prepared_at: AwareDatetime | None = None
    started_at: AwareDatetime | None = None
    ended_at: AwareDatetime | None = None
    duration_s: _Seconds | None = None
    reason: str = ""
    truth: dict[str, Any] | None = None


class KeptOutcome(Kept):
    """A milestone as it was when it was scored."""

    order: _Small
    text: Annotated[str, Field(max_length=200)]
    points: _Small
    required: StrictBool
    reached: StrictBool
    at_s: _Seconds | None = None


class KeptScore(Kept):
    """A line of kind "score"."""

    uuid: UUID
    trial: KeptTrial
    rater: Person
    at: AwareDatetime
    success: StrictBool
    score: Annotated[float, Field(ge=0, le=1)]
    note: str = ""
    failure: Annotated[str, Field(max_length=60)] = ""
    reason: str = ""
    source: Score.Source = Score.Source.HUMAN
    milestones: tuple[KeptOutcome, ...] = ()


class KeptVoid(Kept):
    """A line of kind "void"."""

    trial: KeptTrial
    by: Person
    reason: str
    at: AwareDatetime


_Model = TypeVar("_Model", bound=Kept)


def kept_trial(asked: Mapping[str, Any]) -> KeptTrial | None:
    """The trial that a manifest names; None where its run was none of ours."""
    return read(KeptTrial, asked, "the manifest's trial") if "uuid" in asked else None


def kept_line(line: Mapping[str, Any], number: int) -> KeptScore | KeptVoid | None:
    """The line, the `number`th whole one; None where it is neither score nor void. EvaError says what is wrong."""
    models: dict[object, type[KeptScore] | type[KeptVoid]] = {"score": KeptScore, "void": KeptVoid}
    model = models.get(line.get("kind"))
    return read(model, line, f"line {number} of its scores") if model else None


def read(model: type[_Model], content: Mapping[str, Any], what: str) -> _Model:
    """`content` as that model; EvaError names `what` and the first thing that is wrong with it."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise EvaError(f"{what}: {place} is {first['input']!r:.80}: {first['msg']}") from None
