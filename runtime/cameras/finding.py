"""Findings at a camera's address, in words on which the operator can act."""

from __future__ import annotations

import contextlib
import errno
import socket
from pathlib import Path
from urllib.parse import urlsplit

from runtime.cameras.base import Address

_PEEK_S = 1.0


def found(error: Exception, address: Address, waited: float, allowed: float, opening: bool) -> str:
    """One clause for an error of FFmpeg's after `waited` of `allowed` seconds; never the URL with its password.

    `opening`: nothing has come yet; else pictures have, and the stream breaks.
    """
    import av.error

    if isinstance(error, av.error.ExitError | TimeoutError) or waited >= allowed:
        return f"mute: it sent no picture within {allowed:g} s"
    gone = isinstance(error, av.error.EOFError | ConnectionResetError | BrokenPipeError)
    if gone and not (opening and address.format == "mpjpeg"):
        return "it closed the connection"
    if isinstance(error, ConnectionRefusedError):
        return "refused: nothing listens at that port"
    if isinstance(error, av.error.HTTPNotFoundError):
        return "404: there is nothing at that path"
    if isinstance(error, av.error.HTTPUnauthorizedError | av.error.HTTPForbiddenError):
        return "it wants a login: set user and password_env, or correct them"
    if isinstance(error, av.error.HTTPError):
        return f"it answers with an error: {error.strerror}"
    if address.format == "v4l2":
        return _device(error, address)
    if isinstance(error, FileNotFoundError):
        return "there is no such file"
    if isinstance(error, PermissionError):
        return "this user may not read it"
    if not opening and address.format == "mpjpeg":
        return "it closed the connection, or sent what is no picture"
    if not opening:
        return f"the stream broke: {getattr(error, 'strerror', '') or type(error).__name__}"
    return _no_video(error, address)


def _device(error: Exception, address: Address) -> str:
    """Sentence on what is wrong with a device of this machine."""
    number = getattr(error, "errno", None)
    if isinstance(error, FileNotFoundError):
        others = ", ".join(sorted(map(str, Path("/dev").glob("video*"))))
        return f"there is no such device; this machine has {others or 'no /dev/video*'}"
    if isinstance(error, PermissionError):
        return "this user may not open it: is it in the group video?"
    if number == errno.EBUSY:
        return "another program has it open"
    if number in (errno.ENOTTY, errno.ENODEV, errno.ENXIO):
        return "it is no camera"
    if number == errno.EINVAL:
        asked = ", ".join(f"{key} = {value}" for key, value in address.options.items())
        return f"it cannot do what it is asked for ({asked or 'nothing in particular'})"
    return f"it cannot be read: {getattr(error, 'strerror', '') or type(error).__name__}"


def _no_video(error: Exception, address: Address) -> str:
    """It answers, or its host is not known, and there is no video."""
    parts = urlsplit(address.shown)
    if parts.scheme in ("rtsp", "rtsps", "http", "https") and not _known(parts.hostname or ""):
        return f"the host {parts.hostname} is not known"
    if parts.scheme in ("rtsp", "rtsps"):
        return "what answers there is no RTSP server with a video"
    if parts.scheme in ("http", "https"):
        given = _content_type(address.shown)
        if given.startswith("multipart/"):
            return "its stream ends before the first picture"
        return f"no MJPEG stream: it answers with {given or 'something else'}, not multipart/x-mixed-replace"
    return f"not a video: {getattr(error, 'strerror', '') or type(error).__name__}"


def _known(host: str) -> bool:
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError):
        return False
    return True


def _content_type(url: str) -> str:
    """Content type that a server states; "" where it says nothing."""
    import http.client  # with these every process of a station would start later
    import urllib.error
    import urllib.request

    with contextlib.suppress(OSError, http.client.HTTPException, urllib.error.URLError, ValueError):
        request = urllib.request.Request(url, headers={"Range": "bytes=0-0"})
        with urllib.request.urlopen(request, timeout=_PEEK_S) as answer:
            return str(answer.headers.get("Content-Type") or "")
    return ""
