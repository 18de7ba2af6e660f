"""Outcome of an episode, with the digests of its files and its own seal, by which it can be verified at any time."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from runtime.core.errors import RecordingError
from runtime.recording.digests import Digest, FileDigest, rows_per_piece
from runtime.recording.files import read_json, to_json, write_atomic
from runtime.recording.fragments import fragments
from runtime.recording.layout import Layout
from runtime.recording.tables import SCHEMAS

MANIFEST, OUTCOME = "manifest.json", "outcome.json"
OUTCOME_COPY = "sealed.json"  # exact copy of the outcome: proof that there was one, and its backup
DIGESTS, SEAL, COPY = "digests", "seal", "copy"  # keys of the outcome
_UNSEALED = b"0" * hashlib.sha256().digest_size * 2


def digest_of(path: Path, layout: Layout) -> FileDigest:
    """Return the digest of a file in an episode's folder. Raises RecordingError if it cannot be read."""
    digest = Digest(rows_per_piece(layout.fps) if path.suffix == ".mp4" else 1)
    try:
        for data, rows in _parts(path):
            digest.add(data, rows)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error
    return digest.to_dict()


def digests_of(folder: Path, layout: Layout) -> dict[str, FileDigest]:
    """Return the digests of every file of the episode in `folder`."""
    return {path.name: digest_of(path, layout) for path in sorted(folder.iterdir()) if _counts(path, layout)}


def _counts(path: Path, layout: Layout) -> bool:
    named = {MANIFEST, "events.jsonl", *(f"{camera}.mp4" for camera in layout.cameras)}
    return path.name in named or (path.suffix == ".arrow" and path.name.partition(".")[0] in SCHEMAS)


def seal_outcome(outcome: Mapping[str, object], digests: Mapping[str, FileDigest]) -> bytes:
    """Return the content of outcome.json, with the digests of the files and with a seal.

    The seal is the digest of this content with zeros in place of the seal.
    """
    whole = {**outcome, COPY: OUTCOME_COPY, DIGESTS: digests, SEAL: _UNSEALED.decode()}
    text = to_json(whole, "the outcome", indent=1)
    # The seal is the last key, so its zeros are the last ones in the text.
    before, _, after = text.rpartition(_UNSEALED)
    return before + hashlib.sha256(text).hexdigest().encode() + after


def write_outcome(folder: Path, text: bytes) -> None:
    """Write the sealed outcome and its copy.

    outcome.json is written last, because an episode with it counts as closed.
    """
    for name in (OUTCOME_COPY, OUTCOME):
        write_atomic(folder / name, text)


def read_outcome(folder: Path, name: str = OUTCOME) -> dict[str, Any]:
    """Return the outcome of an episode. Raises RecordingError if it is absent, torn, or differs from its seal.

    Outcomes older than digests have neither digests nor seal. `name` is either of the two outcome files.
    """
    path = folder / name
    outcome = read_json(path)
    if DIGESTS not in outcome and SEAL not in outcome:
        return outcome
    seal = str(outcome.get(SEAL)).encode()
    if isinstance(outcome.get(DIGESTS), Mapping) and len(seal) == len(_UNSEALED):
        before, _, after = path.read_bytes().rpartition(seal)
        if hashlib.sha256(before + _UNSEALED + after).hexdigest().encode() == seal:
            return outcome
    raise RecordingError(f"{path} is damaged: it is not as it was sealed")


def without_digests(outcome: Mapping[str, object]) -> dict[str, object]:
    """Return an outcome without its digests and seal, for places outside outcome.json that contain the outcome too."""
    return {name: value for name, value in outcome.items() if name not in (COPY, DIGESTS, SEAL)}


def _parts(path: Path) -> Iterator[tuple[bytes, int]]:
    """Yield the parts of a file with their number of rows or lines, as its writer added them to the digest."""
    if path.suffix == ".mp4":
        yield from fragments(path)
    elif path.suffix == ".arrow":
        yield from _batches(path.read_bytes())
    elif path.suffix == ".jsonl":
        data = path.read_bytes()
        yield data, data.count(b"\n")
    else:
        yield path.read_bytes(), 0


def _batches(data: bytes) -> Iterator[tuple[bytes, int]]:
    source = pa.BufferReader(data)
    end = 0
    try:
        stream = pa.ipc.open_stream(source)
        rows = 0
        while True:
            yield data[end : source.tell()], rows
            end = source.tell()
            rows = stream.read_next_batch().num_rows
    except (StopIteration, pa.ArrowInvalid, OSError):
        yield data[end:], 0
