"""Current images of a station's cameras, the match of two images, and stored pictures.

A picture is stored in DATA/pictures under the SHA-256 of its bytes. A stored picture never changes, and equal pictures
are stored once.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import numpy as np
import simplejpeg
import zmq
from django.conf import settings

from evaweb.core.errors import Conflict, EvaError, NotFound
from evaweb.stations.models import Station
from evaweb.stations.runtime_client import connection_to
from runtime.core.durable_files import write_durably
from runtime.core.picture_bounds import MOST_PIXELS, require_scans
from runtime.core.sentences import Pattern
from runtime.ipc.bus import CodecError, Subscriber

_NO_PICTURE_FROM_WITHIN_S = Pattern(
    "plans.pictures.no_picture_from_within_s",
    "no picture from {missing} within {patience_s:g} s: check the cameras first",
)
_PICTURE_NOT_ON_THIS_DISK = Pattern(
    "plans.pictures.picture_not_on_this_disk",
    "picture {name:.16} is not on this disk",
)
_PICTURE_X_PIXELS_ALLOWED_PIXELS = Pattern(
    "plans.pictures.picture_x_pixels_allowed_pixels",
    "a picture of {width} x {height} pixels; allowed: {most_pixels} pixels in all, such as 4096 x 4096",
)
_THIS_NO_JPEG = Pattern("plans.pictures.this_no_jpeg", "this is no JPEG: {error}")
_PICTURE_X_PIXELS_ALLOWED_X = Pattern(
    "plans.pictures.picture_x_pixels_allowed_x",
    "a picture of {shape} x {shape_2} pixels; allowed: {width} x {height} or more",
)

WIDTH, HEIGHT = (
    64,
    48,
)  # size at which pictures are compared; the same in static/console/trial/match.js
_TURN_S = 0.1


def current_images(station: Station, cameras: Iterable[str], patience_s: float = 3.0) -> dict[str, bytes]:
    """Return a current JPEG of each camera. Raises: Conflict, which names cameras without an image in `patience_s`."""
    requested = set(cameras)
    images: dict[str, bytes] = {}
    until = time.monotonic() + patience_s
    endpoint = connection_to(station.name).address("media", "cameras")
    with closing(Subscriber(zmq.Context.instance(), endpoint, "camera/")) as subscriber:
        while requested - set(images) and time.monotonic() < until:
            try:
                received = subscriber.receive(_TURN_S)
            except CodecError as error:
                raise Conflict(f"{station.name} publishes pictures that cannot be read: {error}") from None
            images |= {name[7:]: bytes(jpeg) for name, jpeg in received.items() if name[7:] in requested}
    missing = sorted(requested - set(images))
    if missing:
        raise Conflict(_NO_PICTURE_FROM_WITHIN_S(missing=", ".join(missing), patience_s=patience_s))
    return images


def image_match(one: bytes, other: bytes) -> float:
    """Return the correlation of two JPEGs' grey values at 64 x 48: 1 if identical, 0 or below if unrelated.

    Overall brightness and contrast have no influence. 0 if either image is uniform.
    """
    a, b = _grey(one), _grey(other)
    spread = float(np.linalg.norm(a) * np.linalg.norm(b))
    return round(float((a * b).sum()) / spread, 4) if spread > 1e-6 else 0.0


def store_image(jpeg: bytes) -> str:
    """Store the picture, synced to disk, and return its name."""
    name = hashlib.sha256(jpeg).hexdigest()
    path = _path(name)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, jpeg)
    return name


def load_image(name: str) -> bytes:
    """Return the stored picture. Raises: NotFound if it is not on this disk."""
    try:
        return _path(name).read_bytes()
    except FileNotFoundError:
        raise NotFound(_PICTURE_NOT_ON_THIS_DISK(name=name)) from None


def has_image(name: str) -> bool:
    """Return True if the picture is on this disk."""
    return _path(name).is_file()


def _path(name: str) -> Path:
    return Path(settings.DATA_DIR) / "pictures" / f"{name}.jpg"


def decoded(jpeg: bytes, colorspace: str) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Return the pixels [H, W, channels]. Raises: EvaError for an invalid JPEG or one that is too large to decode."""
    try:
        height, width, _, _ = simplejpeg.decode_jpeg_header(jpeg)
        if height * width > MOST_PIXELS:
            raise EvaError(
                _PICTURE_X_PIXELS_ALLOWED_PIXELS(width=width, height=height, most_pixels=MOST_PIXELS)
            )
        require_scans(jpeg)
        return simplejpeg.decode_jpeg(jpeg, colorspace=colorspace)
    except ValueError as error:
        raise EvaError(_THIS_NO_JPEG(error=error)) from None


def brought(
    picture: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], height: int, width: int
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the picture reduced to this height and width by area averaging.

    The result is float64 [height, width, channels].
    """
    rows = np.linspace(0, picture.shape[0], height + 1).round().astype(int)
    columns = np.linspace(0, picture.shape[1], width + 1).round().astype(int)
    bands = np.stack(
        [picture[first:end].sum(axis=0) for first, end in pairwise(rows)]
    )  # avoids a copy of the whole picture
    sums = np.add.reduceat(bands, columns[:-1], axis=1)
    small: np.ndarray[tuple[int, ...], np.dtype[np.float64]] = (
        sums / np.outer(np.diff(rows), np.diff(columns))[..., None]
    )
    return small


def _grey(jpeg: bytes) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the grey values at 64 x 48 minus their mean."""
    picture = decoded(jpeg, "GRAY")
    if picture.shape[0] < HEIGHT or picture.shape[1] < WIDTH:
        raise EvaError(
            _PICTURE_X_PIXELS_ALLOWED_X(
                shape=picture.shape[1], shape_2=picture.shape[0], width=WIDTH, height=HEIGHT
            )
        )
    small = brought(picture, HEIGHT, WIDTH)[..., 0]
    centred: np.ndarray[tuple[int, ...], np.dtype[np.float64]] = small - small.mean()
    return centred
