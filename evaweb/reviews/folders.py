"""Paths of quality reports and their settings in the data folder."""

from __future__ import annotations

from pathlib import Path
from uuid import UUID

from evaweb.episodes.folders import data_dir


def report_file(uuid: UUID) -> Path:
    """Return the file of an episode's quality report."""
    return data_dir() / "quality" / f"{uuid}.json"


def bounds_file() -> Path:
    """Return the file with this lab's own bounds for quality checks of all episodes."""
    return data_dir() / "quality.toml"
