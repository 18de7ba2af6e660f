"""Explanations of camera errors that tell an operator what to do."""

from __future__ import annotations

import contextlib
import errno
import socket
from pathlib import Path
from urllib.parse import urlsplit

from runtime.cameras.base import Address

_PEEK_S = 1.0


def explain_open_error(
    error: Exception, address: Address, waited: float, allowed: float, opening: bool
) -> str:
    """Return one clause about an error of FFmpeg, without the URL and its password.

    Args:
        error: Exception of FFmpeg or the system.
        address: Address of the camera.
        waited: Time until the error [s].
        allowed: Deadline [s].
        opening: True if no picture has arrived yet; False if a running stream broke.
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
    if not opening and address.format == "mpjpeg":  # a response without a length ends in an error
        return "it closed the connection"
    if not opening:
        return f"the stream broke: {getattr(error, 'strerror', '') or type(error).__name__}"
    return _no_video(error, address)


def ended(address: Address, single: bool, stated: str) -> str:
    """Return one clause about a multipart stream that ended without pictures.

    Args:
        address: Address of the camera.
        single: Whether the response was one picture without parts.
        stated: Content type of its parts, "" if none was stated.
    """
    if _is_other(stated):
        return f"it ended, and sent parts of type {stated}, no JPEG"
    if single:
        return "it answers with one picture and ends, not multipart/x-mixed-replace: take the address of its stream"
    return _no_video(EOFError(), address)


def undecodable_text(allowed: float, stated: str) -> str:
    """Return one clause about a stream that had no decodable picture for `allowed` [s].

    `stated` is the content type that it declares.
    """
    kind = f": parts of type {stated}, no JPEG" if _is_other(stated) else ""
    return f"what it sent for {allowed:g} s cannot be decoded{kind}"


def _is_other(stated: str) -> bool:
    return bool(stated) and "jp" not in stated.lower()


def _device(error: Exception, address: Address) -> str:
    """Return one clause about a local device that cannot be opened."""
    number = getattr(error, "errno", None)
    if isinstance(error, FileNotFoundError):
        devices = ", ".join(sorted(map(str, Path("/dev").glob("video*"))))
        return f"there is no such device; this machine has {devices or 'no /dev/video*'}"
    if isinstance(error, PermissionError):
        return "this user may not open it: is it in the group video?"
    if number == errno.EBUSY:
        return "another program has it open"
    if number in (errno.ENOTTY, errno.ENODEV, errno.ENXIO):
        return "it is no camera"
    if number == errno.EINVAL:
        requested = ", ".join(f"{key} = {value}" for key, value in address.options.items())
        return f"it cannot do what was requested ({requested or 'nothing in particular'})"
    return f"it cannot be read: {getattr(error, 'strerror', '') or type(error).__name__}"


def _no_video(error: Exception, address: Address) -> str:
    """Return one clause about a host that is unknown, or responds without a video."""
    parts = urlsplit(address.shown)
    if parts.scheme in ("rtsp", "rtsps", "http", "https") and not _resolves(parts.hostname or ""):
        return f"the host {parts.hostname} is not known"
    if parts.scheme in ("rtsp", "rtsps"):
        return "the server there is not an RTSP server with a video"
    if parts.scheme in ("http", "https"):
        content_type = _content_type(address.shown)
        if content_type.startswith("multipart/"):
            return "its stream ends before the first picture"
        return f"no MJPEG stream: it answers with {content_type or 'something else'}, not multipart/x-mixed-replace"
    return f"not a video: {getattr(error, 'strerror', '') or type(error).__name__}"


def _resolves(host: str) -> bool:
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError):
        return False
    return True


def _content_type(url: str) -> str:
    """Return the content type that a server states, "" if it states none."""
    import http.client  # imported here: every process of a station would start later
    import urllib.error
    import urllib.request

    with contextlib.suppress(OSError, http.client.HTTPException, urllib.error.URLError, ValueError):
        request = urllib.request.Request(url, headers={"Range": "bytes=0-0"})
        with urllib.request.urlopen(request, timeout=_PEEK_S) as answer:
            return str(answer.headers.get("Content-Type") or "")
    return ""
