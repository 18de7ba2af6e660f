"""Videos of Replay in their two places: an episode's preview folder, or the lab's object store.

In the store, a video is found by its digest.
"""

from __future__ import annotations

import json
from pathlib import Path
from uuid import UUID

from evaweb.core.object_stores import (
    StoreError,
    compared,
    required_store,
    the_cache,
    the_store,
)
from evaweb.episodes.folders import data_dir, preview_folder, preview_video
from runtime.core.sentences import Pattern
from runtime.recording.files import write_atomic

INDEX = "stored.json"  # file in a preview folder with the digest of each camera's video
TYPE = "video/mp4"
_NO_INDEX = Pattern(
    "episodes.videos.no_index",
    "{path} does not say which videos are in the store: remove the folder of this preview, and it is made again",
)


def video_address(uuid: UUID, camera: str) -> str:
    """Return a signed URL of a stored video, valid for five minutes; "" if this process serves it itself."""
    digest = "" if preview_video(uuid, camera).is_file() else _stored(uuid).get(camera, "")
    return required_store().address(digest) if digest else ""


def video_file(uuid: UUID, camera: str) -> Path:
    """Return the video as a local file, fetched from the store if needed; a nonexistent path if there is none.

    Raises: StoreError if the store does not deliver it.
    """
    path = preview_video(uuid, camera)
    digest = "" if path.is_file() else _stored(uuid).get(camera, "")
    return the_cache().get(required_store(), digest) if digest else path


def put_videos(uuid: UUID) -> int:
    """Copy the videos of a preview to the store, verify them, then delete the local ones; return their number.

    Raises: StoreError.
    """
    store = required_store()
    videos = sorted(preview_folder(uuid).glob("*.mp4"))
    digests = {path.stem: store.put(path, TYPE) for path in videos}
    if not digests:
        return 0
    for digest in digests.values():
        compared(store, digest)
    text = json.dumps(_stored(uuid) | digests, indent=1, ensure_ascii=False)
    write_atomic(preview_folder(uuid) / INDEX, text.encode())
    for path in videos:
        path.unlink(missing_ok=True)
    return len(digests)


def unstored() -> list[UUID]:
    """Return the previews with videos that are not in the store; [] without a store."""
    if the_store() is None:
        return []
    uuids = []
    for path in sorted((data_dir() / "previews").glob("*/*.mp4")):
        try:
            uuid = UUID(path.parent.name)
        except ValueError:
            continue
        if uuid not in uuids[-1:]:
            uuids.append(uuid)
    return uuids


def _stored(uuid: UUID) -> dict[str, str]:
    path = preview_folder(uuid) / INDEX
    try:
        digests = json.loads(path.read_bytes())
    except FileNotFoundError:
        return {}
    except ValueError:
        digests = None
    if not isinstance(digests, dict) or not all(isinstance(digest, str) for digest in digests.values()):
        raise StoreError(_NO_INDEX(path=path))
    return digests
