"""Encoding of a station's messages into parts of frames: once for all viewers, in the feed's threads."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaweb.console import frame_parts
from evaweb.console.frame_parts import EncodedPart
from evaweb.console.recent_samples import RecentSamples
from evaweb.core.errors import NotFound
from evaweb.stations import redaction as veil
from evaweb.stations.robot_geometry import DrawnRobot, drawn_robot

GHOSTS = 12  # greatest number of whole robots; the page animates one between them
_WORDS = ("chunk", "run", "state", "observation_step", "step", "overlap", "ik")


def encode_chunk(content: Mapping[str, Any], looks: DrawnRobot | None, now: float) -> EncodedPart:
    """Return the part of stream `chunk` for pages; {"chunk": 0} if there is no chunk.

    The part has the station's own keys and these:

    * `targets` [H]: step at which each row is executed (-1: not executed).
    * `tips` float32 [H, arms, 3]: fingertip positions of each row [m, world]; omitted if the robot is not drawn.
    * `ghost_rows` [N]: rows of a proposed chunk that are drawn as robots.
    * `ghost` float32 [N, P, 16]: poses of the robot's parts in these rows; omitted like `tips`.
    """
    facts: dict[str, Any] = {key: content[key] for key in _WORDS if key in content}
    rows = np.asarray(content.get("rows", np.empty((0, 0))), np.float64)
    if "targets" in content:
        facts["targets"] = np.asarray(content["targets"]).tolist()
    if looks is None or rows.ndim != 2 or not len(rows) or rows.shape[1] != looks.robot.dim:
        return frame_parts.encode_facts("chunk", facts, now)
    if not np.isfinite(rows).all():
        return frame_parts.encode_facts("chunk", facts, now)
    links = looks.poses(rows)
    arrays: dict[str, NDArray[Any]] = {"tips": looks.fingertip_positions(links)}
    if content.get("state") == "proposed":
        ghost_rows = np.unique(np.linspace(0, len(rows) - 1, min(GHOSTS, len(rows))).round().astype(int))
        facts["ghost_rows"] = ghost_rows.tolist()
        arrays["ghost"] = links[ghost_rows]
    return frame_parts.encode_numbers("chunk", facts, arrays, now)


log = logging.getLogger(__name__)
_VECTORS = (
    "measured",
    "raw",
    "planned",
    "commanded",
    "simulated",
)  # joint vectors of a sample, by the runtime's names


class StreamEncoder:
    """Encoder of feed messages into parts; `looks` is the robot as drawn, None if it is not drawn.

    The robot is drawn with the groups of joints that the station reports. With `veiled` the parts are for users from
    whom the policy is hidden; the snapshots must already be redacted.
    """

    def __init__(self, robot: str, *, veiled: bool = False) -> None:
        self._robot = robot
        self._veiled = veiled
        self._groups: tuple[str, ...] | None = None  # None: not known yet
        self.looks = _drawn_robot(robot, None)
        self._recent = RecentSamples()

    def encode(self, stream: str, content: Any) -> list[EncodedPart]:
        """Return the parts that represent a message of `stream`."""
        now = time.monotonic()
        if stream == "state":
            self._update_robot(content.get("facts"))
            return [frame_parts.encode_facts(stream, content, now)]
        if stream == "chunk" and self._veiled:
            return [frame_parts.encode_facts("chunk", {"chunk": 0}, now)]
        if stream == "joints" and self._veiled:
            return self._joints(veil.redact_joints(content), now)
        if stream == "joints":
            return self._joints(content, now)
        if stream == "chunk":
            return [encode_chunk(content, self.looks, now)]
        if stream.startswith("camera/"):
            return [frame_parts.encode_picture(stream, content, now)]
        return []

    def _update_robot(self, facts: Any) -> None:
        """Replace the drawn robot if the station reports other groups of joints than before."""
        groups = facts.get("groups") if isinstance(facts, Mapping) else None
        if groups and tuple(groups) != self._groups:
            self._groups = tuple(groups)
            self.looks = _drawn_robot(self._robot, self._groups)

    def _joints(self, content: Mapping[str, Any], now: float) -> list[EncodedPart]:
        vectors = {name: np.asarray(content[name], np.float32) for name in _VECTORS if name in content}
        facts = {key: content[key] for key in content if key not in vectors}
        parts = [
            frame_parts.encode_numbers("joints", facts, vectors, now),
            self._recent.add_sample(vectors, facts, now),
        ]
        if self.looks and _drawable(vectors["measured"], self.looks):
            rows = shown_rows(vectors, engaged=bool(content.get("engaged")))
            poses = self.looks.poses(rows)
            parts.append(frame_parts.encode_array("poses", poses if len(rows) > 1 else poses[0], now))
        return parts


def shown_rows(vectors: Mapping[str, NDArray[Any]], *, engaged: bool) -> NDArray[np.float32]:
    """Return the joints of each robot to draw: measured; commanded; and, in a simulated run, simulated.

    float32 [1, 2 or 3, D]. If there is a simulated robot but no command, the second row is NaN.
    """
    measured, commanded = vectors["measured"], vectors["commanded"]
    sent = engaged and bool(np.isfinite(commanded).all())
    simulated = vectors.get("simulated")
    if simulated is not None and simulated.shape == measured.shape and np.isfinite(simulated).all():
        return np.stack([measured, commanded if sent else np.full_like(measured, np.nan), simulated])
    return np.stack([measured, commanded]) if sent else measured[None]


def _drawable(joints: NDArray[Any], drawn: DrawnRobot) -> bool:
    return joints.shape == (drawn.robot.dim,) and bool(np.isfinite(joints).all())


def _drawn_robot(robot: str, groups: tuple[str, ...] | None) -> DrawnRobot | None:
    """Return the robot to draw; None, with a log line, if it cannot be drawn."""
    try:
        return drawn_robot(robot, groups)
    except NotFound as error:
        log.error("no 3D scene: %s", error)
        return None
