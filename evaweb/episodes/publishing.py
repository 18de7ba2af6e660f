"""Which dataset an episode goes to, and what its raters said of it."""

from __future__ import annotations

import json
import re
from pathlib import Path

from evaweb.episodes.manifest import RecordedEpisode
from evaweb.journal import read_numbered_lines
from runtime.recording.files import RecordingError

DATASET_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_ROBOT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")


def success_of(path: Path) -> bool | None:
    """Success by the newest score; None without a score. To void a trial changes no score."""
    success = None
    for _, line in read_numbered_lines(path):
        try:
            said = json.loads(line)
        except (ValueError, RecursionError):  # it never counted
            continue
        if not isinstance(said, dict) or said.get("kind", "score") != "score":
            continue
        if isinstance(said.get("success"), bool):
            success = said["success"]
    return success


def dataset_name(recorded: RecordedEpisode, *, scored: bool, simulated: bool) -> str:
    """Rollouts and demonstrations, real and simulated, scored and unscored ones are kept apart, robot by robot.

    What was collected in a session goes where that says. RecordingError where a name cannot name a folder.
    """
    if recorded.session.get("dataset"):
        return session_dataset(str(recorded.session["dataset"]), simulated=simulated)
    robot = str(recorded.facts.get("robot", ""))
    if not _ROBOT.fullmatch(robot):
        raise RecordingError(
            f"manifest of {recorded.uuid}: robot.name is {robot!r}, must be letters, digits, '.', '_' and '-'"
        )
    demonstration = recorded.facts["kind"] != "rollout"
    parts = ["demonstrations" if demonstration else "rollouts", robot]
    parts += ["simulated"] if simulated else []
    parts += ["unscored"] if not demonstration and not scored else []
    return "-".join(parts)


def session_dataset(name: str, *, simulated: bool) -> str:
    """The folder of a session's dataset; RecordingError where the name cannot be one."""
    if not DATASET_NAME.fullmatch(name):
        raise RecordingError(
            f"session.dataset is {name!r:.110}, must be letters, digits, '.', '_' and '-', the first no sign"
        )
    return f"{name}-simulated" if simulated else name
