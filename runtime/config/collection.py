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
    """Collection of demonstrations: how a person drives the robot, and which data must be recorded."""

    source: Literal["relay", "node"]
    """"relay": the station turns the leader's joints into commands and applies its own safety checks; "node": the
    robot's node reads its own leader and drives the robot, and the action that it reports is recorded."""
    leader: LeaderConfig | None = None
    """Connection to the leader; required with source = "relay", an error with source = "node"."""
    mode: Literal["absolute", "relative"] = "absolute"
    """"absolute": the robot moves to the leader's joints; "relative": it moves by as much as the leader has moved since
    the start. Only "absolute" with source = "node"."""
    max_age_s: float = Field(default=0.3, gt=0, le=2)
    """Silence of the leader after which the robot holds, with source = "relay" [s]."""
    dataset: str = Field(default="demonstrations", pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$")
    """Name of the dataset for which the episodes are recorded."""
    streams: list[Measured] = Field(default_factory=list)
    """Measurements besides joints that the robot must provide; an episode does not begin without them."""
    columns: list[Column] | None = None
    """Data recorded besides joints and actions, at least those of `streams`; absent: all that are available."""
    cameras: list[str] | None = Field(default=None, min_length=1)
    """Observation keys of the cameras that are recorded; absent: all cameras of the station."""
    primary_camera: str | None = None
    """Camera that represents the episode if only one image is shown; absent: the first recorded camera."""
    max_skew_s: Annotated[float, Field(gt=0, le=5)] = 0.1
    """Largest difference between the times of the streams of one row [s]; beyond it the row is flagged."""
    min_length_s: float = Field(default=1.0, ge=0)
    """Duration below which an episode is reported as too short [s]."""

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
        recorded = self.cameras or list(cameras)
        return self.primary_camera or (recorded[0] if recorded else "")

    def manifest_entry(self, cameras: tuple[str, ...]) -> dict[str, Any]:
        """Return these settings as a manifest has them; `cameras` are the station's."""
        recorded = [key for key in cameras if self.cameras is None or key in self.cameras]
        return {
            **self.model_dump(mode="json", exclude={"leader", "max_age_s"}),
            "leader": "" if self.leader is None else self.leader.kind,
            "cameras": recorded,
            "primary_camera": self.primary_camera_of(cameras),
        }


def check(settings: CollectionSettings | None, cameras: tuple[str, ...]) -> None:
    """Raise ConfigurationError if the settings name cameras that the station lacks."""
    if settings is None:
        return
    unknown = [key for key in settings.cameras or () if key not in cameras]
    if unknown:
        raise ConfigurationError(
            f"collection.cameras: {', '.join(unknown)} are no cameras of this station; allowed: {', '.join(cameras)}"
        )
    recorded = settings.cameras or list(cameras)
    if settings.primary_camera is not None and settings.primary_camera not in recorded:
        raise ConfigurationError(
            f"collection.primary_camera = {settings.primary_camera!r}; allowed: {', '.join(recorded)}"
        )
