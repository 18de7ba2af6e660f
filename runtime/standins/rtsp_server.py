"""Stand-in for an RTSP camera: H.264 over RTP interleaved in the RTSP connection (RFC 2326, 3550, 6184)."""

from __future__ import annotations

import re
import select
import socket
import struct
import time
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

from runtime.standins.camera_server import CameraServer, picture

_CLOCK = 90_000  # [Hz] clock of RTP for video
_PAYLOAD = 96  # dynamic payload type
_LARGEST = 1400  # [bytes] of a NAL unit in one packet; longer units are fragmented (FU-A)
_ERRORS = {"not_found": "404 Not Found", "no_login": "401 Unauthorized"}


class RtspServer(CameraServer):
    """Server of one H.264 track; `stamp_offset` [s] is added to the images' time stamps, and may be changed at any
    time.
    """

    scheme = "rtsp"
    stamp_offset = 0.0

    def _speak(self, client: socket.socket) -> None:
        pending = b""
        while True:
            got = client.recv(4096)
            if not got:
                return
            pending += got
            while b"\r\n\r\n" in pending:
                request, _, pending = pending.partition(b"\r\n\r\n")
                if self._answer(client, request.decode("latin-1")) == "PLAY":
                    self._play(client)
                    return

    def _answer(self, client: socket.socket, request: str) -> str:
        method = request.partition(" ")[0]
        sequence = re.search(r"CSeq:\s*(\d+)", request, re.IGNORECASE)
        lines = [f"CSeq: {sequence.group(1) if sequence else 0}"]
        status, body = "200 OK", ""
        if method == "OPTIONS":
            lines.append("Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN, GET_PARAMETER")
        elif method == "DESCRIBE" and self.fault in _ERRORS:
            status = _ERRORS[self.fault]
        elif method == "DESCRIBE":
            body = f"v=0\r\no=- 1 1 IN IP4 127.0.0.1\r\ns=eva\r\nt=0 0\r\nm=video 0 RTP/AVP {_PAYLOAD}\r\n"
            body += f"a=rtpmap:{_PAYLOAD} H264/{_CLOCK}\r\na=fmtp:{_PAYLOAD} packetization-mode=1\r\n"
            body += "a=control:track1\r\n"
            lines += ["Content-Type: application/sdp", f"Content-Base: {self.url}/"]
        elif method == "SETUP":
            lines += ["Transport: RTP/AVP/TCP;unicast;interleaved=0-1", "Session: 1"]
        elif method == "PLAY":
            lines.append("Session: 1")
        lines.append(f"Content-Length: {len(body)}")
        client.sendall("\r\n".join([f"RTSP/1.0 {status}", *lines, "", body]).encode())
        return method if status == "200 OK" else ""

    def _play(self, client: socket.socket) -> None:
        begun = due = time.monotonic()
        number, packets = 0, 0
        encoder: Any = None
        while True:
            readable, _, _ = select.select([client], [], [], max(0.0, due - time.monotonic()))
            if readable and not self._still_wanted(client):
                return
            if time.monotonic() < due:
                continue
            if self.fault == "silent":
                if not client.recv(4096):
                    return
                continue
            if encoder is None or (encoder.width, encoder.height) != self.size:
                encoder = self._encoder()
            stamp = int((due - begun + self.stamp_offset) * _CLOCK)
            for unit, last in self._units(encoder, number):
                for payload, marked in _payloads(unit, last):
                    packets += 1
                    self._send(client, payload, marked, packets, stamp)
                    if self.fault == "torn":
                        return
            number, due = number + 1, due + 1 / self.rate
            self.sent += 1

    def _still_wanted(self, client: socket.socket) -> bool:
        """Answer the client's keep-alives; return False if the client ends the session."""
        got = client.recv(4096).decode("latin-1")
        if not got or got.startswith("TEARDOWN"):
            return False
        if got[0] != "$":  # "$" begins an interleaved RTCP report of the client
            self._answer(client, got)
        return True

    def _encoder(self) -> Any:
        import av

        encoder: Any = av.CodecContext.create("libx264", "w")
        encoder.width, encoder.height = self.size
        encoder.pix_fmt, encoder.time_base = "yuv420p", Fraction(1, _CLOCK)
        encoder.options = {"preset": "ultrafast", "tune": "zerolatency", "g": "10"}
        return encoder

    def _units(self, encoder: Any, number: int) -> Iterator[tuple[bytes, bool]]:
        """Yield the NAL units of an image, each with whether it is the last one."""
        import av

        frame = av.VideoFrame.from_ndarray(picture(number, *self.size), format="rgb24")
        frame.pts, frame.time_base = int(number / self.rate * _CLOCK), Fraction(1, _CLOCK)
        stream = b"".join(bytes(packet) for packet in encoder.encode(frame))
        units = [unit.rstrip(b"\0") for unit in re.split(b"\0\0\0?\1", stream) if unit]
        for index, unit in enumerate(units):
            broken = unit[:1] + bytes(len(unit) - 1) if self.fault == "nonsense" else unit
            yield broken, index == len(units) - 1

    def _send(self, client: socket.socket, payload: bytes, marked: bool, packets: int, stamp: int) -> None:
        head = struct.pack(
            ">BBHII", 0x80, _PAYLOAD | marked << 7, packets & 0xFFFF, stamp & 0xFFFFFFFF, 0xE7A
        )
        packet = head + payload
        framed = b"$\0" + struct.pack(">H", len(packet)) + packet
        self._send_picture(client, framed[: len(framed) // 2] if self.fault == "torn" else framed)


def _payloads(unit: bytes, last: bool) -> Iterator[tuple[bytes, bool]]:
    """Yield pairs (payload, whether it ends an image) that together carry one NAL unit.

    A unit is sent whole or, if it is too large, in fragments (FU-A). `last` is True for the last unit of an image.
    """
    if len(unit) <= _LARGEST:
        yield unit, last
        return
    kind, content = unit[0], unit[1:]
    pieces = [content[at : at + _LARGEST] for at in range(0, len(content), _LARGEST)]
    for index, piece in enumerate(pieces):
        begins, ends = index == 0, index == len(pieces) - 1
        yield bytes([kind & 0x60 | 28, begins << 7 | ends << 6 | kind & 0x1F]) + piece, last and ends
