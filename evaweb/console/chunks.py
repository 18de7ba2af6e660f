"""Encoding of a chunk for the 3D scene: fingertips of every row, and whole robots for some rows of a proposed chunk."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaweb.console import frame_parts
from evaweb.console.frame_parts import EncodedPart
from evaweb.stations.robot_geometry import DrawnRobot

GHOSTS = 12  # greatest number of whole robots; the page animates one between them
_WORDS = ("chunk", "run", "state", "observation_step", "step", "overlap", "ik")


def encode_chunk(content: Mapping[str, Any], looks: DrawnRobot | None, now: float) -> EncodedPart:
    """Return stream `chunk` for pages; {"chunk": 0} if there is none.

    In addition to the station's own keys: `targets` [H], the step of each row (-1: not executed), and `ghost_rows`
    [N], the rows drawn as robots. Arrays: `tips` float32 [H, arms, 3], fingertip positions of each row [m, world];
    `ghost` float32 [N, P, 16], only of a proposed chunk. Both are omitted if the robot is not drawn.
    """
    words: dict[str, Any] = {key: content[key] for key in _WORDS if key in content}
    rows = np.asarray(content.get("rows", np.empty((0, 0))), np.float64)
    if "targets" in content:
        words["targets"] = np.asarray(content["targets"]).tolist()
    if looks is None or rows.ndim != 2 or not len(rows) or rows.shape[1] != looks.robot.dim:
        return frame_parts.encode_facts("chunk", words, now)
    if not np.isfinite(rows).all():
        return frame_parts.encode_facts("chunk", words, now)
    links = looks.poses(rows)
    arrays: dict[str, NDArray[Any]] = {"tips": looks.fingertip_positions(links)}
    if content.get("state") == "proposed":
        shown = np.unique(np.linspace(0, len(rows) - 1, min(GHOSTS, len(rows))).round().astype(int))
        words["ghost_rows"] = shown.tolist()
        arrays["ghost"] = links[shown]
    return frame_parts.encode_numbers("chunk", words, arrays, now)
