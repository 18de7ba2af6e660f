"""Sentences about cameras without pictures, made by the coordinator from media's camera report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from runtime.cameras.base import CameraCondition
from runtime.core.sentences import Pattern

NOT_LIVE = Pattern("cameras.not_live", "camera {camera} ({source}) is {condition}: {why}")


def describe_camera_problems(
    cameras: Mapping[str, Mapping[str, Any]], keys: Iterable[str] | None = None
) -> list[str]:
    """Return a sentence for each camera, or each of `keys`, that is not live: camera, source, condition, reason."""
    chosen = cameras if keys is None else [key for key in keys if key in cameras]
    return [
        NOT_LIVE(camera=key, source=told["source"], condition=told["condition"], why=told["why"])
        for key in chosen
        if (told := cameras[key])["condition"] != CameraCondition.LIVE
    ]
