"""Current pictures of a station's cameras, the match of two pictures, and the pictures that are kept.

A picture is kept in DATA/pictures under the SHA-256 of its bytes: it is never changed, and the same one is there once.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from uuid import uuid4

import numpy as np
import simplejpeg
import zmq
from django.conf import settings

from evaweb.errors import Conflict, EvaError, NotFound
from evaweb.stations.models import Station
from evaweb.stations.runtime_client import wire_to
from runtime.ipc.bus import CodecError, Subscriber

WIDTH, HEIGHT = (
    64,
    48,
)  # to which both pictures are brought before they are compared; static/console/trial/match.js does too
_TURN_S = 0.1


def now(station: Station, cameras: Iterable[str], patience_s: float = 3.0) -> dict[str, bytes]:
    """A JPEG of each of `cameras` as it is published now; Conflict names those that show nothing."""
    wanted = set(cameras)
    found: dict[str, bytes] = {}
    until = time.monotonic() + patience_s
    endpoint = wire_to(station.name).address("media", "cameras")
    with closing(Subscriber(zmq.Context.instance(), endpoint, "camera/")) as subscriber:
        while wanted - set(found) and time.monotonic() < until:
            try:
                heard = subscriber.receive(_TURN_S)
            except CodecError as error:
                raise Conflict(f"{station.name} publishes pictures that cannot be read: {error}") from None
            found |= {name[7:]: bytes(jpeg) for name, jpeg in heard.items() if name[7:] in wanted}
    missing = sorted(wanted - set(found))
    if missing:
        raise Conflict(
            f"no picture from {', '.join(missing)} within {patience_s:g} s: see to the cameras first"
        )
    return found


def match(one: bytes, other: bytes) -> float:
    """Match of two JPEGs: correlation of their grey values at 64 x 48, from 1, the same, to 0, and below 0.

    Brightness and contrast as a whole do not count. 0 where one of them is of one grey.
    """
    a, b = _grey(one), _grey(other)
    spread = float(np.linalg.norm(a) * np.linalg.norm(b))
    return round(float((a * b).sum()) / spread, 4) if spread > 1e-6 else 0.0


def keep(jpeg: bytes) -> str:
    """Put the picture on the disk, and return its name."""
    name = hashlib.sha256(jpeg).hexdigest()
    path = _path(name)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_suffix(f".{uuid4().hex}")
        with draft.open("wb") as file:
            file.write(jpeg)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    return name


def kept(name: str) -> bytes:
    """The picture of that name; NotFound where it is not on this disk."""
    try:
        return _path(name).read_bytes()
    except FileNotFoundError:
        raise NotFound(f"picture {name:.16} is not on this disk") from None


def is_kept(name: str) -> bool:
    """True if the picture of that name is on this disk."""
    return _path(name).is_file()


def _path(name: str) -> Path:
    return Path(settings.DATA_DIR) / "pictures" / f"{name}.jpg"


def _grey(jpeg: bytes) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Grey values at 64 x 48 around their mean; each is the mean of the pixels that it stands for."""
    try:
        picture = simplejpeg.decode_jpeg(jpeg, colorspace="GRAY")[..., 0].astype(np.float64)
    except ValueError as error:
        raise EvaError(f"this is no JPEG: {error}") from None
    rows = np.linspace(0, picture.shape[0], HEIGHT + 1).round().astype(int)
    columns = np.linspace(0, picture.shape[1], WIDTH + 1).round().astype(int)
    if (np.diff(rows) < 1).any() or (np.diff(columns) < 1).any():
        raise EvaError(
            f"a picture of {picture.shape[1]} x {picture.shape[0]} pixels; allowed: {WIDTH} x {HEIGHT} or more"
        )
    sums = np.add.reduceat(np.add.reduceat(picture, rows[:-1], axis=0), columns[:-1], axis=1)
    small = sums / np.outer(np.diff(rows), np.diff(columns))
    centred: np.ndarray[tuple[int, ...], np.dtype[np.float64]] = small - small.mean()
    return centred
