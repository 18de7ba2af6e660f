"""New names for the columns of a foreign dataset, so that training code finds the columns that it expects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from runtime.core.errors import RecordingError
from runtime.datasets.features import INDEX_COLUMNS

Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class ColumnRenaming:
    """New name by old name; columns that are not in it keep their names."""

    new_by_old: Mapping[str, str]

    @property
    def empty(self) -> bool:
        """True if every column keeps its name."""
        return not self.new_by_old

    def new_name(self, old: str) -> str:
        """Return the new name of `old`."""
        return self.new_by_old.get(old, old)

    def old_name(self, new: str) -> str:
        """Return the old name of the column whose new name is `new`."""
        return next((old for old, name in self.new_by_old.items() if name == new), new)

    def rename_keys(self, mapping: Mapping[str, Value]) -> dict[str, Value]:
        """Return `mapping` with renamed keys, in its order."""
        return {self.new_name(key): value for key, value in mapping.items()}

    def require(self, features: Mapping[str, object]) -> None:
        """Check that the columns of `features` can be renamed without a conflict. Raises: RecordingError."""
        for old, new in self.new_by_old.items():
            if old not in features:
                raise RecordingError(f"there is no feature {old!r} to rename, there are {sorted(features)}")
            if old in INDEX_COLUMNS or new in INDEX_COLUMNS:
                raise RecordingError(f"{old!r} cannot be renamed {new!r}: {sorted(INDEX_COLUMNS)} are fixed")
            if not new or "/" in new:
                raise RecordingError(f"{new!r} is no name of a feature: it is empty or has a slash")
        if len(self.rename_keys(features)) != len(features):
            raise RecordingError(f"two features would have the same name: {dict(self.new_by_old)}")
