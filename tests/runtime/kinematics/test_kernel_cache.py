"""Whether a robot's kernels are on disk: all that was noted must still be there, or a set-up says that it compiles."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import robots
from runtime.kinematics import kernel_cache

ROBOT = robots.load_robot("ur5e")


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with two functions' kernels, as numba names its files, of which the robot's are noted."""
    monkeypatch.setattr(kernel_cache, "folder", lambda: tmp_path)
    for name in ("chunks.solve-65.py311", "chains.poses-92.py311"):
        (tmp_path / "kernels").mkdir(exist_ok=True)
        (tmp_path / "kernels" / f"{name}.nbi").write_bytes(b"index")
        for number in (1, 2):
            (tmp_path / "kernels" / f"{name}.{number}.nbc").write_bytes(b"code" * number)
    assert not kernel_cache.is_compiled(ROBOT)
    kernel_cache.note_compiled(ROBOT)
    return tmp_path / "kernels"


def test_what_is_there_is_compiled_for_that_robot_alone(kept: Path) -> None:
    assert kernel_cache.is_compiled(ROBOT)
    assert not kernel_cache.is_compiled(robots.load_robot("agilex_piper"))
    (kept / "chunks.solve-65.py311.3.nbc").write_bytes(b"another robot's")
    assert kernel_cache.is_compiled(ROBOT)
    assert kernel_cache.forget()
    assert not kernel_cache.is_compiled(ROBOT)


@pytest.mark.parametrize(
    "harm",
    [
        lambda kept: (kept / "chunks.solve-65.py311.2.nbc").unlink(),
        lambda kept: (kept / "chunks.solve-65.py311.2.nbc").write_bytes(b"half"),
        lambda kept: (kept / "chains.poses-92.py311.nbi").unlink(),
        lambda kept: (kept / "chains.poses-92.py311.nbi").write_bytes(b""),
        lambda kept: next(kept.parent.glob("*.compiled")).write_text("{"),
        lambda kept: next(kept.parent.glob("*.compiled")).write_text(""),  # as it once was
    ],
)
def test_what_is_not_whole_is_not(kept: Path, harm: Callable[[Path], object]) -> None:
    harm(kept)
    assert not kernel_cache.is_compiled(ROBOT)
    kernel_cache.note_compiled(ROBOT)
    assert kernel_cache.is_compiled(ROBOT)


def test_nowhere_to_keep_them_is_not_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "folder", lambda: None)
    kernel_cache.note_compiled(ROBOT)
    assert not kernel_cache.is_compiled(ROBOT)
