"""Static files served from memory, compressed once, at URLs that contain a digest of all files.

A page has about a hundred of these files. A browser that has a file already does not request it again. After an upgrade
the URLs differ, so that no page mixes files of two versions.
"""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import mimetypes
import re
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import brotli
from django.core.exceptions import SuspiciousFileOperation

from evaweb.serving.headers import DEFAULT_HEADERS

_PREFIX = "/static/"
_DIGEST = re.compile(r"([0-9a-f]{16})/")
_KINDS = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".json": "application/json"}
_KEPT, _ASKED = b"max-age=31536000, public, immutable", b"max-age=0, public"
_ENCODINGS: Mapping[bytes, Callable[[bytes], bytes]] = {  # the first that a browser accepts is used
    b"br": lambda content: brotli.compress(content, quality=11),
    b"gzip": lambda content: gzip.compress(content, 6, mtime=0),
}
_POLICY = b"default-src 'self'"  # for scripts that run as workers


def digest_of(folders: Iterable[Path], *versions: str) -> str:
    """Return a digest [16 hex digits] of all files in `folders` and of the versions of packages with static files."""
    digest = hashlib.sha256("\n".join(versions).encode())
    for folder in folders:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            content = hashlib.sha256(path.read_bytes()).hexdigest()
            digest.update(f"{path.relative_to(folder).as_posix()} {content}\n".encode())
    return digest.hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class _File:
    """File that is ready for sending.

    Attributes:
        packed: Compressed content by encoding, without those that do not shrink it.
        tag: Entity tag.
        changed: Modification time. If it is later than the start of this process, the content may differ from that
            for which the digest in the URL stands.
    """

    content: bytes
    packed: Mapping[bytes, bytes]
    headers: list[tuple[bytes, bytes]]
    tag: bytes
    changed: float


class StaticFiles:
    """ASGI middleware that serves static files and passes all other requests on.

    `digest` is part of the URLs in pages; responses to such URLs may be cached forever. If it is empty, as during
    development, each file is read anew.
    """

    def __init__(self, application: Callable[..., Awaitable[Any]], digest: str) -> None:
        self._application, self._digest, self._began = application, digest, time.time()
        self._files: dict[str, _File] = {}

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        path: str = scope["path"]
        name = path.removeprefix(_PREFIX)
        match = _DIGEST.match(name)
        file = None
        if path.startswith(_PREFIX) and scope["method"] in ("GET", "HEAD"):
            file = await self._file(name[match.end() :] if match else name)
        if file is None:
            await self._application(scope, receive, send)
        else:
            current = match is not None and match[1] == self._digest and file.changed < self._began
            await _answer(scope, send, file, _KEPT if current else _ASKED)

    async def _file(self, name: str) -> _File | None:
        if (cached := self._files.get(name)) is not None:
            return cached
        if (path := _found(name)) is None:
            return None
        file = await asyncio.to_thread(_made, path)
        if self._digest:
            self._files[name] = file
        return file


def _found(name: str) -> Path | None:
    from django.contrib.staticfiles import finders

    try:
        path = finders.find(name) if name else None
    except (SuspiciousFileOperation, ValueError):  # a path outside the folder, or with a NUL
        return None
    return Path(path) if isinstance(path, str) and Path(path).is_file() else None


def _made(path: Path) -> _File:
    content = path.read_bytes()
    kind = _KINDS.get(path.suffix) or mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    text = kind.startswith("text/") or kind in _KINDS.values()
    packed = {name: pack(content) for name, pack in _ENCODINGS.items()} if text else {}
    packed = {name: shorter for name, shorter in packed.items() if len(shorter) < len(content)}
    headers = [
        (b"content-type", f"{kind}; charset=utf-8".encode() if text else kind.encode()),
        (b"vary", b"Accept-Encoding"),
    ]
    tag = b'"%s"' % hashlib.sha256(content).hexdigest()[:32].encode()
    return _File(content, packed, headers, tag, path.stat().st_mtime)


async def _answer(scope: dict[str, Any], send: Any, file: _File, keeping: bytes) -> None:
    request_headers = dict(scope["headers"])
    accepted = {part.strip() for part in request_headers.get(b"accept-encoding", b"").split(b",")}
    encoding = next((name for name in file.packed if name in accepted), b"")
    tag = b'%s-%s"' % (file.tag[:-1], encoding) if encoding else file.tag
    headers = [*file.headers, (b"cache-control", keeping), (b"etag", tag)]
    if tag in request_headers.get(b"if-none-match", b""):
        await _send(send, 304, headers)
        return
    content = file.packed[encoding] if encoding else file.content
    if encoding:
        headers.append((b"content-encoding", encoding))
    headers.append((b"content-length", b"%d" % len(content)))
    await _send(send, 200, headers, content if scope["method"] == "GET" else b"")


async def _send(send: Any, status: int, headers: list[tuple[bytes, bytes]], content: bytes = b"") -> None:
    all_headers = dict(DEFAULT_HEADERS) | {b"content-security-policy": _POLICY} | dict(headers)
    await send({"type": "http.response.start", "status": status, "headers": list(all_headers.items())})
    await send({"type": "http.response.body", "body": content})
