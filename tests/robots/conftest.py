from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import robots

Edit = Callable[..., Path]


@pytest.fixture
def edited(tmp_path: Path) -> Edit:
    """A copy of the Piper's folder in which strings of robot.toml were replaced, each at its first place."""

    def copy(*replacements: tuple[str, str]) -> Path:
        folder = tmp_path / "copy"
        shutil.copytree(robots.load_robot("agilex_piper").folder, folder)
        file = folder / "robot.toml"
        text = file.read_text()
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new, 1)
        file.write_text(text)
        return folder

    return copy
