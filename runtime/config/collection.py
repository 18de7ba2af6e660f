"""Settings for collecting demonstrations: the leader, and the required content of an episode."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, model_validator

from runtime.core.errors import ConfigurationError
from runtime.core.plugins import kind_union
from runtime.core.settings import Settings

if TYPE_CHECKING:

    class LeaderConfig(Settings):
        """Any leader's section."""

        kind: str
else:
    LeaderConfig = kind_union("runtime.teleoperators")

Measured = Literal["qvel", "effort", "eef"]
Column = Literal["qvel", "effort", "eef", "eef_action"]


class CollectionSettings(Settings):
    """Collecting demonstrations: a person drives the robot, and what must be recorded of it."""

    source: Literal["relay", "node"]
    """"relay": the leader's joints become commands through our own safety; "node": the robot's node reads a leader of
    its own and drives, and the action that it reports is recorded."""
    leader: LeaderConfig | None = None
    """Where the leader of "relay" is."""
    mode: Literal["absolute", "relative"] = "absolute"
    """"absolute": the robot goes where the leader is; "relative": by as much as it moved since the start."""
    max_age_s: float = Field(default=0.3, gt=0, le=2)
    """Silence of the leader of "relay" after which the robot holds [s]."""
    dataset: str = Field(default="demonstrations", pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$")
    """Name of the dataset that the episodes are meant for."""
    streams: list[Measured] = Field(default_factory=list)
    """What the robot must measure beside its joints; an episode does not begin without."""
    columns: list[Column] | None = None
    """Which of these are recorded beside joints and actions; all that there are where it is not given."""
    cameras: list[str] | None = Field(default=None, min_length=1)
    """Observation keys of the cameras that are recorded; all of the station where it is not given."""
    primary_camera: str | None = None
    """The camera that stands for the episode where one picture must; the first one where it is not given."""
    max_skew_s: Annotated[float, Field(gt=0, le=5)] = 0.1
    """How far apart in time the streams of one row may be before the row is flagged [s]."""
    min_length_s: float = Field(default=1.0, ge=0)
    """An episode that is shorter is said to be too short [s]."""

    @model_validator(mode="after")
    def _fit_the_source(self) -> CollectionSettings:
        if self.source == "relay" and self.leader is None:
            raise ConfigurationError(
                'collection.leader is missing: source = "relay" needs a table with a kind'
            )
        if self.source == "node" and self.leader is not None:
            raise ConfigurationError(
                'collection.leader with source = "node": the node reads its own; leave it out'
            )
        if self.source == "node" and self.mode != "absolute":
            raise ConfigurationError(
                'collection.mode with source = "node": the node decides that; leave it out'
            )
        missing = [name for name in self.streams if self.columns is not None and name not in self.columns]
        if missing:
            raise ConfigurationError(
                f"collection.columns leaves out {', '.join(missing)}, which collection.streams asks for"
            )
        return self

    def primary_camera_of(self, cameras: tuple[str, ...]) -> str:
        """Return the key of the camera that represents an episode; "" without cameras."""
        kept = self.cameras or list(cameras)
        return self.primary_camera or (kept[0] if kept else "")

    def manifest_entry(self, cameras: tuple[str, ...]) -> dict[str, Any]:
        """Return these settings in the form of a manifest; `cameras` are the station's."""
        kept = [key for key in cameras if self.cameras is None or key in self.cameras]
        return {
            **self.model_dump(mode="json", exclude={"leader", "max_age_s"}),
            "leader": "" if self.leader is None else self.leader.kind,
            "cameras": kept,
            "primary_camera": self.primary_camera_of(cameras),
        }


def check(settings: CollectionSettings | None, cameras: tuple[str, ...]) -> None:
    """Raise ConfigurationError if it names cameras that the station lacks."""
    if settings is None:
        return
    unknown = [key for key in settings.cameras or () if key not in cameras]
    if unknown:
        raise ConfigurationError(
            f"collection.cameras: {', '.join(unknown)} are no cameras of this station; allowed: {', '.join(cameras)}"
        )
    kept = settings.cameras or list(cameras)
    if settings.primary_camera is not None and settings.primary_camera not in kept:
        raise ConfigurationError(
            f"collection.primary_camera = {settings.primary_camera!r}; allowed: {', '.join(kept)}"
        )
