"""Parts of frames, encoded from what a station publishes: once for all viewers, in the feed's own threads."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaweb.console import parts
from evaweb.console.chunks import encode_chunk
from evaweb.console.parts import EncodedPart
from evaweb.console.recent import RecentSamples
from evaweb.errors import NotFound
from evaweb.stations import redaction as veil
from evaweb.stations.robot_geometry import DrawnRobot, drawn_robot

log = logging.getLogger(__name__)
_VECTORS = ("measured", "raw", "planned", "commanded", "simulated")  # of the joints, as the runtime has them


class StreamEncoder:
    """Makes parts of what a feed tells; `looks` is the robot as the station has it, None where it is not drawn.

    `veiled`: for users from whom the policy is hidden; snapshots come to it covered already.
    """

    def __init__(self, robot: str, *, veiled: bool = False) -> None:
        self._robot = robot
        self._veiled = veiled
        self._groups: tuple[str, ...] | None = None  # None: nobody has said yet
        self.looks = _looks(robot, None)
        self._recent = RecentSamples()

    def encode(self, stream: str, content: Any) -> list[EncodedPart]:
        """The parts that `content` of a stream is shown as."""
        now = time.monotonic()
        if stream == "state":
            self._update_robot(content.get("facts"))
            return [parts.encode_facts(stream, content, now)]
        if stream == "chunk" and self._veiled:
            return [parts.encode_facts("chunk", {"chunk": 0}, now)]
        if stream == "joints" and self._veiled:
            return self._joints(veil.redact_joints(content), now)
        if stream == "joints":
            return self._joints(content, now)
        if stream == "chunk":
            return [encode_chunk(content, self.looks, now)]
        if stream.startswith("camera/"):
            return [parts.encode_picture(stream, content, now)]
        return []

    def _update_robot(self, facts: Any) -> None:
        """The robot is drawn with the groups that the station says it has."""
        groups = facts.get("groups") if isinstance(facts, Mapping) else None
        if groups and tuple(groups) != self._groups:
            self._groups = tuple(groups)
            self.looks = _looks(self._robot, self._groups)

    def _joints(self, content: Mapping[str, Any], now: float) -> list[EncodedPart]:
        vectors = {name: np.asarray(content[name], np.float32) for name in _VECTORS if name in content}
        words = {key: content[key] for key in content if key not in vectors}
        made = [
            parts.encode_numbers("joints", words, vectors, now),
            self._recent.add_sample(vectors, words, now),
        ]
        if self.looks and _drawable(vectors["measured"], self.looks):
            rows = shown_rows(vectors, engaged=bool(content.get("engaged")))
            poses = self.looks.poses(rows)
            made.append(parts.encode_array("poses", poses if len(rows) > 1 else poses[0], now))
        return made


def shown_rows(vectors: Mapping[str, NDArray[Any]], *, engaged: bool) -> NDArray[np.float32]:
    """The joints of each robot that is drawn: measured; commanded; of a run in simulation the simulated one.

    float32 [1, 2 or 3, D]. Where nothing is commanded but something is simulated the second row is NaN.
    """
    measured, commanded = vectors["measured"], vectors["commanded"]
    sent = engaged and bool(np.isfinite(commanded).all())
    simulated = vectors.get("simulated")
    if simulated is not None and simulated.shape == measured.shape and np.isfinite(simulated).all():
        return np.stack([measured, commanded if sent else np.full_like(measured, np.nan), simulated])
    return np.stack([measured, commanded]) if sent else measured[None]


def _drawable(joints: NDArray[Any], looks: DrawnRobot) -> bool:
    return joints.shape == (looks.robot.dim,) and bool(np.isfinite(joints).all())


def _looks(robot: str, groups: tuple[str, ...] | None) -> DrawnRobot | None:
    """None: the robot is not drawn, and the log says why."""
    try:
        return drawn_robot(robot, groups)
    except NotFound as error:
        log.error("no 3D scene: %s", error)
        return None
