"""Stores of large immutable files: objects named by their SHA-256, in a folder or an S3-compatible bucket.

Both kinds of store implement `Store`. Code that needs a local file gets it from `LocalCache`, which checks the digest.
The S3 client is obstore (MIT), the Python binding of Apache Arrow's object_store in Rust: one wheel of 6 MB that
depends only on typing_extensions, with signed URLs, multipart uploads and retries. boto3 brings four packages and the
tables of all of Amazon's services; django-storages is a layer above it for model fields, which these files are not.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, Protocol

from django.conf import settings

from evaweb.core.environment import Bucket
from evaweb.core.errors import EvaError
from runtime.core.durable_files import sync_folder
from runtime.core.sentences import Pattern, fixed

LONGEST_S = 300  # longest validity of a signed URL
_STEP = 1 << 20  # size of a part [bytes]
_IN_USE_S = 600.0  # time after its last use during which a cached file is not removed
_DRAFT_S = 24 * 3600.0  # time since its last part after which a file that is not complete is abandoned
_CONNECT, _ANSWER = "3s", "30s"
_RETRIES: Any = {"max_retries": 3, "retry_timeout": timedelta(seconds=20)}
_NO_STORE = fixed(
    "object_stores.no_store",
    "this file was put into a store, and EVA_STORE names none: set it as it was",
)
_FAILED = Pattern("object_stores.failed", "the store {store} does not {what}: {why:.300}")
_CHANGED = Pattern(
    "object_stores.changed", "the object {digest} in the store {store} is not what its name says: {why}"
)


class StoreError(EvaError):
    """Error if an object store is missing, full or refuses a request; the message names store and request."""

    status = 503


class Store(Protocol):
    """Objects by the hexadecimal SHA-256 of their content. Every method may wait for a network and raise StoreError."""

    def put(self, path: Path, content_type: str) -> str:
        """Store a file unless it is there already; return its digest."""

    def exists(self, digest: str) -> bool:
        """Return True if the store has the object."""

    def read(self, digest: str) -> Iterator[bytes]:
        """Yield the content in parts; it is not compared with the digest."""

    def delete(self, digest: str) -> None:
        """Delete the object; do nothing if it is absent."""

    def address(self, digest: str, seconds: int = LONGEST_S) -> str:
        """Return a signed URL for browsers, valid for `seconds` (at most LONGEST_S) [s]; "" if unsupported."""

    def file(self, digest: str) -> Path | None:
        """Return the local path of the object, None if the store has no local files."""


@dataclass(frozen=True, slots=True)
class FolderStore:
    """Objects in a folder, which may be on a network file system: FOLDER/ab/abcdef..."""

    folder: Path

    def put(self, path: Path, content_type: str) -> str:
        try:
            draft, digest = _draft(self.folder / ".drafts", _parts(path))
            target = self._at(digest)
            target.parent.mkdir(exist_ok=True)
            os.replace(draft, target)  # an existing file has the same content
            for folder in (target.parent, self.folder):
                sync_folder(folder)  # the caller may remove the only other copy
        except OSError as error:
            raise self._failed("take a file", error) from None
        return digest

    def exists(self, digest: str) -> bool:
        return self._at(digest).is_file()

    def read(self, digest: str) -> Iterator[bytes]:
        try:
            yield from _parts(self._at(digest))
        except OSError as error:
            raise self._failed(f"give {digest}", error) from None

    def delete(self, digest: str) -> None:
        try:
            self._at(digest).unlink(missing_ok=True)
        except OSError as error:
            raise self._failed(f"remove {digest}", error) from None

    def address(self, digest: str, seconds: int = LONGEST_S) -> str:
        return ""

    def file(self, digest: str) -> Path | None:
        return self._at(digest)

    def _at(self, digest: str) -> Path:
        return self.folder / digest[:2] / digest

    def _failed(self, action: str, error: OSError) -> StoreError:
        return StoreError(_FAILED(store=self.folder, what=action, why=error.strerror or str(error)))


class S3Store:
    """Objects in a bucket of an S3-compatible server: PREFIX/ab/abcdef..."""

    def __init__(self, given: Bucket) -> None:
        from obstore.store import S3Store as Remote

        self._given = given
        self._bucket = Remote(
            given.name,
            prefix=given.prefix or None,
            endpoint=given.origin,
            region=given.region,
            access_key_id=given.key,
            secret_access_key=given.secret,
            virtual_hosted_style_request=False,
            client_options={
                "allow_http": given.origin.startswith("http://"),
                "connect_timeout": _CONNECT,
                "timeout": _ANSWER,
            },
            retry_config=_RETRIES,
        )

    def put(self, path: Path, content_type: str) -> str:
        import obstore

        try:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            if not self.exists(digest):
                obstore.put(self._bucket, _named(digest), path, attributes={"Content-Type": content_type})
        except Exception as error:
            raise self._failed("take a file", error) from None
        return digest

    def exists(self, digest: str) -> bool:
        import obstore

        try:
            obstore.head(self._bucket, _named(digest))
        except FileNotFoundError:
            return False
        except Exception as error:
            raise self._failed(f"say whether it has {digest}", error) from None
        return True

    def read(self, digest: str) -> Iterator[bytes]:
        import obstore

        try:
            for part in obstore.get(self._bucket, _named(digest)).stream(min_chunk_size=_STEP):
                yield bytes(part)
        except Exception as error:
            raise self._failed(f"give {digest}", error) from None

    def delete(self, digest: str) -> None:
        import obstore

        try:
            obstore.delete(self._bucket, _named(digest))
        except FileNotFoundError:
            return
        except Exception as error:
            raise self._failed(f"remove {digest}", error) from None

    def address(self, digest: str, seconds: int = LONGEST_S) -> str:
        import obstore

        good_for = timedelta(seconds=min(seconds, LONGEST_S))
        try:
            return str(obstore.sign(self._bucket, "GET", _named(digest), good_for))
        except Exception as error:
            raise self._failed(f"sign an address of {digest}", error) from None

    def file(self, digest: str) -> Path | None:
        return None

    def _failed(self, action: str, error: Exception) -> StoreError:
        if isinstance(error, StoreError):
            return error
        reason = str(error).partition("\n")[0]  # further lines are internals of obstore
        return StoreError(_FAILED(store=self._given, what=action, why=reason))


@dataclass(frozen=True, slots=True)
class LocalCache:
    """Local copies of stored objects, at most `most` bytes; the least recently used are removed first."""

    folder: Path
    most: int

    def get(self, store: Store, digest: str) -> Path:
        """Return a local file whose content matches `digest`. Raises: StoreError if it is unavailable or differs."""
        if (file := store.file(digest)) is not None:
            return file
        path = self.folder / digest[:2] / digest
        try:
            os.utime(path)
        except FileNotFoundError:
            self._bring(store, digest, path)
        return path

    def _bring(self, store: Store, digest: str, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft, actual = _draft(self.folder, store.read(digest))
        if actual != digest:
            draft.unlink()
            raise _changed(store, digest, actual)
        os.replace(draft, path)
        self._trim()

    def _trim(self) -> None:
        """Remove the oldest files beyond `most` bytes, except those used within _IN_USE_S: a caller may open them."""
        files = [(path, path.stat()) for path in self.folder.glob("??/*") if path.exists()]
        size, now = sum(stat.st_size for _, stat in files), time.time()
        for path, stat in sorted(files, key=lambda one: one[1].st_mtime):
            if size <= self.most or now - stat.st_mtime < _IN_USE_S:
                return
            path.unlink(missing_ok=True)
            size -= stat.st_size


def the_store() -> Store | None:
    """Return the lab's store, None if large files stay in the data folder."""
    place: Path | Bucket | None = settings.EVA_STORE
    if place is None:
        return None
    return FolderStore(place) if isinstance(place, Path) else S3Store(place)


def required_store() -> Store:
    """Return the lab's store. Raises: StoreError if no store is configured any more."""
    store = the_store()
    if store is None:
        raise StoreError(_NO_STORE)
    return store


def the_cache() -> LocalCache:
    """Return the lab's cache of stored objects."""
    return LocalCache(Path(settings.DATA_DIR) / "cache", settings.EVA_CACHE_BYTES)


def compared(store: Store, digest: str) -> None:
    """Read the object back and raise StoreError if it does not match its digest; call before deleting another copy."""
    actual = hashlib.sha256()
    for part in store.read(digest):
        actual.update(part)
    if actual.hexdigest() != digest:
        raise _changed(store, digest, actual.hexdigest())


def fetch(store: Store, digest: str, path: Path) -> None:
    """Write the object to `path`, which appears complete, flushed to disk and equal to its digest, or not at all.

    Raises: StoreError if the store does not deliver it or it differs; OSError if the disk refuses it.
    """
    draft, actual = _draft(path.parent, store.read(digest))
    try:
        if actual != digest:
            raise _changed(store, digest, actual)
        draft.chmod(0o644)  # drafts are private
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
    sync_folder(path.parent)


def _changed(store: Store, digest: str, actual: str) -> StoreError:
    return StoreError(_CHANGED(digest=digest, store=type(store).__name__, why=actual))


def _parts(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while data := file.read(_STEP):
            yield data


def _draft(folder: Path, parts: Iterable[bytes]) -> tuple[Path, str]:
    """Write `parts` to a new file in `folder`, flushed to disk; return its path and SHA-256.

    Files that a killed process left there more than _DRAFT_S ago are removed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for abandoned in folder.glob(".draft*"):
        with suppress(FileNotFoundError):  # another process has removed it, or given it its name
            if time.time() - abandoned.stat().st_mtime > _DRAFT_S:
                abandoned.unlink()
    digest = hashlib.sha256()
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".draft", delete=False) as draft:
        try:
            for part in parts:
                digest.update(part)
                draft.write(part)
            draft.flush()
            os.fsync(draft.fileno())
        except BaseException:
            Path(draft.name).unlink(missing_ok=True)
            raise
    return Path(draft.name), digest.hexdigest()


def _named(digest: str) -> str:
    return f"{digest[:2]}/{digest}"
