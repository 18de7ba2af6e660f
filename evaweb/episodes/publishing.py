"""Which dataset an episode goes to, and what its raters said of it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from evaweb.episodes.recorded import Recorded
from runtime.recording.files import RecordingError

_ROBOT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}")


def score_lines(path: Path) -> Iterator[Mapping[str, Any]]:
    """The lines of a scores file that are whole, oldest first; none where there is no file."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    for line in data.splitlines():
        try:
            content = json.loads(line)
        except ValueError:  # torn by a power cut before it counted
            continue
        if isinstance(content, dict):
            yield content


def success_of(path: Path) -> bool | None:
    """What the newest score says; None where nobody has scored it. To void a trial changes no score."""
    success = None
    for line in score_lines(path):
        if line.get("kind", "score") == "score" and isinstance(line.get("success"), bool):
            success = line["success"]
    return success


def dataset_name(recorded: Recorded, *, scored: bool, simulated: bool) -> str:
    """Rollouts and demonstrations, real and simulated, scored and unscored ones are kept apart, robot by robot.

    RecordingError where the robot's name cannot name a folder.
    """
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
