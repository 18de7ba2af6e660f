"""Newest image of a station's first camera, for pages with many stations: one request serves all viewers."""

from __future__ import annotations

import threading
import time
from collections import defaultdict

from evaweb.console.feed import feeds
from evaweb.core.errors import Conflict, NotFound, StationGone
from evaweb.plans import image_store
from evaweb.plans.bench_checks import cameras_of
from evaweb.stations.models import Station
from runtime.core.sentences import Pattern

_HAS_NO_CAMERA = Pattern("console.stills.has_no_camera", "{name} has no camera")
_SENDS_NO_PICTURE = Pattern("console.stills.sends_no_picture", "{name} sends no picture of {cameras}")

KEPT_S = 4.0  # age limit of a cached image
_PATIENCE_S = 0.8

_stills: dict[str, tuple[float, bytes]] = {}
_turns: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)


def still_of(station: Station) -> bytes:
    """Return a JPEG of the station's first camera; the image was requested at most KEPT_S [s] ago.

    Raises:
        NotFound: If the station does not run, has no camera or sends no image.
    """
    link = feeds.get(station.name).link
    cameras = cameras_of(station)[:1]
    if not link.ok or not cameras:
        raise NotFound(link.reason if cameras else _HAS_NO_CAMERA(name=station.name))
    with _turns[station.name]:
        at, jpeg = _stills.get(station.name, (0.0, b""))
        if not at or time.monotonic() - at > KEPT_S:
            jpeg = _fetch(station, cameras)
            _stills[station.name] = (time.monotonic(), jpeg)
    if not jpeg:  # a missing image is cached too, so that other viewers need not wait for it
        raise NotFound(_SENDS_NO_PICTURE(name=station.name, cameras=cameras[0]))
    return jpeg


def _fetch(station: Station, cameras: list[str]) -> bytes:
    """Return a current JPEG of the first of the `cameras`; b"" if an image did not come in time."""
    try:
        return image_store.current_images(station, cameras, _PATIENCE_S)[cameras[0]]
    except (Conflict, StationGone):  # the second: the link was lost since it was looked at
        return b""
