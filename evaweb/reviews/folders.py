"""Places of an episode's report and reviews in the data folder."""

from __future__ import annotations

from pathlib import Path
from uuid import UUID

from evaweb.episodes.folders import data_dir


def report_file(uuid: UUID) -> Path:
    """File of the checks' report on an episode."""
    return data_dir() / "quality" / f"{uuid}.json"


def bounds_file() -> Path:
    """Other bounds of the checks than the usual ones, for all episodes of this lab."""
    return data_dir() / "quality.toml"
