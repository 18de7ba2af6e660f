"""Stand-in for a camera that sends MJPEG over HTTP."""

from __future__ import annotations

import socket
import time

import simplejpeg

from runtime.standins.camera_server import CameraServer, picture

_ERRORS = {"not_found": "404 Not Found", "no_login": "401 Unauthorized"}


class MjpegServer(CameraServer):
    """Server of multipart/x-mixed-replace with one part per image.

    `headers` are the lines before each image, in which {length} is replaced by its size [bytes]. Further faults: "html"
    answers with a page, "png" with parts of another type, "still" with a single image.
    """

    scheme = "http"
    headers: tuple[str, ...] = ("Content-Type: image/jpeg", "Content-Length: {length}")

    def _speak(self, client: socket.socket) -> None:
        request = b""
        while b"\r\n\r\n" not in request:
            got = client.recv(4096)
            if not got:
                return
            request += got
        if self.fault in _ERRORS:
            client.sendall(f"HTTP/1.1 {_ERRORS[self.fault]}\r\nContent-Length: 0\r\n\r\n".encode())
        elif self.fault == "html":
            page = b"<html>log in</html>"
            head = f"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: {len(page)}\r\n\r\n"
            client.sendall(head.encode() + page)
        elif self.fault == "still":
            jpeg = simplejpeg.encode_jpeg(picture(0, *self.size), quality=90)
            client.sendall(b"HTTP/1.1 200 OK\r\nContent-Type: image/jpeg\r\nConnection: close\r\n\r\n" + jpeg)
        else:
            head = "HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=eva\r\n\r\n"
            client.sendall(head.encode())
            self._play(client)

    def _play(self, client: socket.socket) -> None:
        due, number = time.monotonic(), 0
        while True:
            time.sleep(max(0.0, due - time.monotonic()))
            if self.fault == "silent":
                client.recv(1)  # until the client disconnects
                return
            jpeg = simplejpeg.encode_jpeg(picture(number, *self.size), quality=90)
            if self.fault in ("nonsense", "png"):
                jpeg = bytes(reversed(jpeg))
            headers = ("Content-Type: image/png",) if self.fault == "png" else self.headers
            lines = "".join(f"{line}\r\n" for line in ("--eva", *headers, ""))
            part = lines.format(length=len(jpeg)).encode()
            if self.fault == "torn":
                client.sendall(part + jpeg[: len(jpeg) // 2])
                return
            self._send_picture(client, part + jpeg + b"\r\n")
            number, due = number + 1, due + 1 / self.rate
            self.sent += 1
