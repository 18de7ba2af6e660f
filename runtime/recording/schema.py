"""Schema of a demonstration, which a manifest's `collection` requires; other episodes record everything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from runtime.core.errors import RecordingError
from runtime.core.types import Observation


@dataclass(frozen=True, slots=True)
class Schema:
    """Cameras and vectors that an episode records; `cameras` or `columns` None: all of them.

    `required` are the vectors that every row must have. If `reported`, the actions are those that the node reports.
    `max_skew_s` is the largest permitted spread of capture times [s], None without a limit.
    """

    cameras: tuple[str, ...] | None = None
    columns: tuple[str, ...] | None = None
    required: tuple[str, ...] = ()
    reported: bool = False
    max_skew_s: float | None = None

    @classmethod
    def from_manifest(cls, manifest: Mapping[str, Any]) -> Schema:
        """Read the schema from a manifest that media has not completed yet."""
        collection = manifest.get("collection")
        if not collection:
            return cls()
        columns = collection["columns"]
        return cls(
            tuple(collection["cameras"]),
            None if columns is None else tuple(columns),
            tuple(collection["streams"]),
            collection["source"] == "node",
            collection.get("max_skew_s"),
        )

    def recorded_cameras(self, cameras: Sequence[str]) -> tuple[str, ...]:
        """Return the cameras among `cameras` that are recorded."""
        return tuple(key for key in cameras if self.cameras is None or key in self.cameras)

    def records_column(self, column: str) -> bool:
        """Return True if the vector `column` is recorded when it is available."""
        return self.columns is None or column in self.columns

    def streams(self, *, qvel: bool, effort: bool, posed: bool) -> dict[str, bool]:
        """Return whether each vector stream is recorded, for all vector streams other than joints and actions.

        `qvel` and `effort` state whether the robot reports velocities and efforts. `posed` states whether it has arms,
        and therefore poses.
        """
        available = {"qvel": qvel, "effort": effort, "eef": posed, "eef_action": posed}
        return {name: has and self.records_column(name) for name, has in available.items()}

    def check(self, newest: Observation) -> None:
        """Raise RecordingError if the robot does not measure a stream that every row must have."""
        missing = [name for name in self.required if getattr(newest, name) is None]
        if missing:
            raise RecordingError(
                f"the robot measures no {', '.join(missing)}, which collection.streams asks for"
            )
