"""A chunk of actions as the scene shows it: dots for every row, whole robots for some of a proposed one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaweb.console import parts
from evaweb.console.parts import EncodedPart
from evaweb.stations.robot_geometry import DrawnRobot

GHOSTS = 12  # whole robots at most; the page moves the ghost on between them
_WORDS = ("chunk", "run", "state", "observation_step", "step", "overlap", "ik")


def encode_chunk(content: Mapping[str, Any], looks: DrawnRobot | None, now: float) -> EncodedPart:
    """Stream `chunk` of the runtime for pages; {"chunk": 0} where there is none any more.

    Beside the runtime's own words: `targets` [H], the step each row is for (-1: it is not executed), and
    `ghost_rows` [N], the rows that are drawn as robots. Arrays: `tips` float32 [H, arms, 3], where each row
    takes the fingertips [m, world]; `ghost` float32 [N, P, 16], of a proposed chunk alone. Neither is there
    where the robot is not drawn.
    """
    words: dict[str, Any] = {key: content[key] for key in _WORDS if key in content}
    rows = np.asarray(content.get("rows", np.empty((0, 0))), np.float64)
    if "targets" in content:
        words["targets"] = np.asarray(content["targets"]).tolist()
    if looks is None or rows.ndim != 2 or not len(rows) or rows.shape[1] != looks.robot.dim:
        return parts.encode_facts("chunk", words, now)
    if not np.isfinite(rows).all():
        return parts.encode_facts("chunk", words, now)
    links = looks.poses(rows)
    arrays: dict[str, NDArray[Any]] = {"tips": looks.fingertip_positions(links)}
    if content.get("state") == "proposed":
        shown = np.unique(np.linspace(0, len(rows) - 1, min(GHOSTS, len(rows))).round().astype(int))
        words["ghost_rows"] = shown.tolist()
        arrays["ghost"] = links[shown]
    return parts.encode_numbers("chunk", words, arrays, now)
