"""Single images of cameras that a dataset stores in a column instead of a video."""

from __future__ import annotations

import io

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import simplejpeg
from PIL import Image

from evaweb.core.errors import NotFound
from evaweb.datasets.playback import PlayedEpisode
from runtime.core.picture_bounds import DAMAGED, TooLargeError, require_scans, require_size
from runtime.core.sentences import Pattern
from runtime.datasets.video_frames import stored_row, to_rgb
from runtime.recording.files import RecordingError

_PICTURES_VIDEO = Pattern("datasets.stills.pictures_video", "the pictures of {camera} are in a video")

QUALITY = 85
_SHOWN = {"JPEG": "image/jpeg", "PNG": "image/png"}  # formats that are served unchanged


def still_image(episode: PlayedEpisode, camera: str, row: int) -> tuple[bytes, str]:
    """Return image `row` of a camera and its media type; re-encoded only if browsers cannot show it.

    Raises: RecordingError, NotFound.
    """
    if episode.video(camera) is not None:
        raise NotFound(_PICTURES_VIDEO(camera=camera))
    key = episode.cameras[camera]
    content = _stored(episode, key, row)
    try:
        require_scans(content, f"picture {row} of {key!r} has")
        with Image.open(io.BytesIO(content)) as picture:
            require_size(*picture.size, f"picture {row} of {key!r} is")
            kind = _SHOWN.get(picture.format or "")
            if kind and not picture.mode.startswith("I"):  # depth images, which browsers show as black
                return content, kind
            pixels = np.ascontiguousarray(to_rgb(picture))
    except TooLargeError as error:
        raise RecordingError(str(error)) from None
    except (*DAMAGED, Image.DecompressionBombError) as error:
        raise RecordingError(f"picture {row} of {key!r} cannot be decoded: {error}") from error
    jpeg: bytes = simplejpeg.encode_jpeg(pixels, quality=QUALITY)
    return jpeg, "image/jpeg"


def _stored(episode: PlayedEpisode, key: str, row: int) -> bytes:
    """Return the encoded image in one row of the column, without converting other episodes' images."""
    path = episode.entry.data
    try:
        columns = [key, *(["episode_index"] if episode.entry.shared else [])]
        table = pq.read_table(path, columns=columns)
        if episode.entry.shared:
            table = table.filter(pc.equal(table["episode_index"], episode.index))
        picture = table[key][row].as_py()
    except (OSError, pa.ArrowException, KeyError, IndexError) as error:
        raise RecordingError(f"{path}: no picture {row} of {key!r}: {error}") from error
    stored = stored_row(picture)
    if stored is None or not (stored.get("bytes") or stored.get("path")):
        raise RecordingError(
            f"{path}: picture {row} of {key!r} is {type(picture).__name__}, expected a coded picture"
        )
    if stored.get("bytes"):
        return bytes(stored["bytes"])
    return _file(episode, key, str(stored["path"]))


def _file(episode: PlayedEpisode, key: str, name: str) -> bytes:
    root = episode.dataset.root.resolve()
    path = (root / name).resolve()
    if not path.is_relative_to(root):
        raise RecordingError(f"a picture of {key!r} leads out of the dataset: {name!r:.120}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
