"""Drafting of a robot's folder: robot.toml, URDF, meshes and README; it is loaded as a test before it is moved into
place.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from robots import urdf
from robots.draft.draft_model import RobotDraft, build_draft
from robots.draft.mesh_copy import MeshCopyReport, copy_urdf
from robots.draft.postures import PostureSearch
from robots.draft.rendering import render_readme, render_robot_toml
from robots.errors import RobotError
from robots.inspection import Inspection, inspect_robot
from robots.loading import load_robot, robot_names
from robots.robot import Robot
from robots.rotations import Float64

_NAME = re.compile(r"[a-z][a-z0-9_]*")
_MOST = 8  # greatest number of copies of one arm


@dataclass(frozen=True, slots=True)
class DraftResult:
    """Result of drafting: the new `folder` of a robot, a report on its shapes, and the findings of its inspection."""

    folder: Path
    pictures: MeshCopyReport
    inspection: Inspection


def draft_robot(name: str, source: Path, into: Path, copies: int = 1) -> DraftResult:
    """Draft the robot `name` from the URDF `source` in a new folder of `into`.

    Args:
        name: Name of the robot.
        source: URDF file.
        into: Folder of robots.
        copies: Number of copies of the single arm in the URDF, side by side.

    Raises:
        RobotError: If it fails; nothing is left behind.
    """
    folder = _free(name, into)
    if not 1 <= copies <= _MOST:
        raise RobotError(f"{copies} copies; allowed: 1 to {_MOST}")
    tree = urdf.read(source)
    title = urdf.document(source).get("name") or name
    into.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{name}-", dir=into) as scratch:
        draft = Path(scratch) / name
        draft.mkdir()
        copied = draft / f"{name}.urdf"
        try:
            pictures = copy_urdf(tree, copied)
            guessed = build_draft(tree, copied, pictures.drawn, title, copies)
            (draft / "README.md").write_text(render_readme(name, guessed, pictures), "utf-8")
            _write(draft, guessed)
        except RobotError as error:  # messages name temporary files that no longer exist when they are read
            text = str(error).replace(str(copied), str(source)).replace(str(draft), str(folder))
            raise RobotError(text) from None
        draft.rename(folder)
    return DraftResult(folder, pictures, inspect_robot(folder))


def _free(name: str, into: Path) -> Path:
    if not _NAME.fullmatch(name):
        raise RobotError(
            f"{name!r} is no name for a robot; allowed: a letter, then letters, digits and _, all small"
        )
    folder = into / name
    if folder.exists():
        raise RobotError(f"{folder} is there already; allowed: a new folder")
    if name in robot_names():
        raise RobotError(f"there is a robot {name!r} already; there are {', '.join(robot_names())}")
    return folder


def _write(folder: Path, guessed: RobotDraft) -> None:
    """Write robot.toml: first with every group at rest, then again with postures in which nothing touches."""
    file = folder / "robot.toml"
    home = {group.name: group.rest for group in guessed.groups}
    file.write_text(render_robot_toml(guessed, {"home": home}, ()), "utf-8")
    robot = load_robot(folder, [group.name for group in guessed.groups])
    postures = PostureSearch(robot, urdf.read(robot.urdf))
    by_name = {"home": postures.home()}
    by_name["ready"] = postures.ready(by_name["home"])
    poses = {name: _parts(robot, q) for name, q in by_name.items()}
    file.write_text(render_robot_toml(guessed, poses, postures.touching(by_name)), "utf-8")


def _parts(robot: Robot, q: Float64) -> Mapping[str, Sequence[float]]:
    return {name: part.tolist() for name, part in robot.split(q).items()}
