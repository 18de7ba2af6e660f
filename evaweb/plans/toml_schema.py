"""Format of a TOML file with scenes, checkpoints, plans and references; `toml_exchange` imports and exports such
files.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from evaweb.plans.region_matching import Region
from runtime.benches.schema import DEFAULT_BENCH

_Name = Annotated[str, Field(min_length=1, max_length=120)]


class Table(BaseModel):
    """Table of the file; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class PositionTable(Table):
    """Position of a scene."""

    number: int = Field(ge=0, lt=2**15)
    label: str = ""
    description: str = ""
    bench: dict[str, list[float] | dict[str, list[float] | float | str]] | None = None


class MilestoneTable(Table):
    """Milestone of a scene."""

    order: int = Field(ge=0, lt=2**15)
    text: str = Field(min_length=1, max_length=200)
    points: int = Field(default=1, ge=1, le=100)
    required: bool = False
    time_limit_s: float | None = None
    truth: str = ""


class SceneTable(Table):
    """Scene with its positions and milestones."""

    name: _Name
    title: _Name
    instruction: str
    criterion: str = ""
    layout: str = ""
    bench: str = DEFAULT_BENCH
    time_limit_s: float | None = None
    ordered: bool = False
    failure_required: bool = False
    position: list[PositionTable] = Field(min_length=1)
    milestone: list[MilestoneTable] = []


class CheckpointTable(Table):
    """Checkpoint with its parent in training."""

    name: _Name
    description: str = ""
    policy: dict[str, Any] = {}
    digest: str = ""
    parent: str | None = None
    recipe: str = ""
    tags: list[str] = []
    strategy: dict[str, Any] | None = None
    anchor: bool = False


class PlaceTable(Table):
    """Position identified by scene and number."""

    scene: str
    number: int


class PlanTable(Table):
    """Table of a plan in the file; its import creates a draft."""

    name: _Name
    title: _Name
    question: str = ""
    positions: list[PlaceTable] = Field(min_length=1)
    checkpoints: list[str] = Field(min_length=1)
    repetitions: int = Field(default=1, ge=1)
    stations: list[str] = []
    strategy: dict[str, Any] | None = None
    blind: bool = True
    allocation: Literal["paired", "random"] = "paired"
    stopping: str = "none"
    comparing: Literal["pair", "control", "all"] = "pair"
    drop_arms: bool = False
    outcome: str = "success"
    margin: float | None = None
    look_after: list[int] = []
    alpha: float = 0.05
    comparison: list[str] = Field(default=[], max_length=2)
    second_rater_share: float = 0.0
    match_gate: float | None = None
    on_estop: str = "judged"
    on_interruption: str = "judged"
    on_timeout: str = "judged"


class ReferenceTable(Table):
    """Reference picture of a camera at a position."""

    scene: str = Field(max_length=60)
    position: int = Field(ge=0, lt=2**15)
    station: str = Field(max_length=63)
    camera: str = Field(min_length=1, max_length=63)
    picture: str = Field(pattern=r"^[0-9a-f]{64}$")
    regions: list[Region] = []


class File(Table):
    """Content of a whole file."""

    scene: list[SceneTable] = []
    checkpoint: list[CheckpointTable] = []
    plan: list[PlanTable] = []
    reference: list[ReferenceTable] = []
