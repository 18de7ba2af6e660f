"""Content required of a demonstration by its manifest's `collection`; other episodes have all there is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from runtime.core.errors import RecordingError
from runtime.core.types import Observation


@dataclass(frozen=True, slots=True)
class Schema:
    """Which cameras and vectors are recorded; None for all. `reported`: actions are those that the node reports."""

    cameras: tuple[str, ...] | None = None
    columns: tuple[str, ...] | None = None
    required: tuple[str, ...] = ()
    reported: bool = False
    max_skew_s: float | None = None

    @classmethod
    def from_manifest(cls, manifest: Mapping[str, Any]) -> Schema:
        """That of a manifest, before media has completed it."""
        said = manifest.get("collection")
        if not said:
            return cls()
        columns = said["columns"]
        return cls(
            tuple(said["cameras"]),
            None if columns is None else tuple(columns),
            tuple(said["streams"]),
            said["source"] == "node",
            said.get("max_skew_s"),
        )

    def recorded_cameras(self, cameras: Sequence[str]) -> tuple[str, ...]:
        """Those of `cameras` that are recorded."""
        return tuple(key for key in cameras if self.cameras is None or key in self.cameras)

    def records_column(self, column: str) -> bool:
        """True if that vector is recorded, where it is there."""
        return self.columns is None or column in self.columns

    def streams(self, *, qvel: bool, effort: bool, posed: bool) -> dict[str, bool]:
        """Which vectors beside joints and actions are recorded of a robot that has these; `posed`: it has arms."""
        there = {"qvel": qvel, "effort": effort, "eef": posed, "eef_action": posed}
        return {name: has and self.records_column(name) for name, has in there.items()}

    def check(self, newest: Observation) -> None:
        """RecordingError where the robot does not measure what every row must have."""
        missing = [name for name in self.required if getattr(newest, name) is None]
        if missing:
            raise RecordingError(
                f"the robot measures no {', '.join(missing)}, which collection.streams asks for"
            )
