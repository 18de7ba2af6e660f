"""Dataset to which an episode is published, and the success of the episode according to its scores."""

from __future__ import annotations

import json
import re
from pathlib import Path

from evaweb.episodes.manifest import RecordedEpisode
from evaweb.records.journal import read_numbered_lines
from runtime.recording.files import RecordingError

DATASET_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_ROBOT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")


def success_of(path: Path) -> bool | None:
    """Return the success in the newest score of the scores file at `path`; None if it contains no score.

    A void of the trial does not change the result.
    """
    success = None
    for _, line in read_numbered_lines(path):
        try:
            fields = json.loads(line)
        except (ValueError, RecursionError):  # an invalid line has never counted
            continue
        if not isinstance(fields, dict) or fields.get("kind", "score") != "score":
            continue
        if isinstance(fields.get("success"), bool):
            success = fields["success"]
    return success


def dataset_name(recorded: RecordedEpisode, *, scored: bool, simulated: bool) -> str:
    """Return the name of the dataset to which an episode is published.

    There is one dataset per robot and kind of episode (rollouts or demonstrations). Simulated episodes and unscored
    rollouts have datasets of their own. An episode of a collection session is published to the session's dataset
    instead.

    Raises:
        RecordingError: If the name of the robot, or of the session's dataset, cannot be the name of a folder.
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
    """Return the folder name of a session's dataset. Raises: RecordingError if it is invalid."""
    if not DATASET_NAME.fullmatch(name):
        raise RecordingError(
            f"session.dataset is {name!r:.110}, must be letters, digits, '.', '_' and '-', the first no sign"
        )
    return f"{name}-simulated" if simulated else name
