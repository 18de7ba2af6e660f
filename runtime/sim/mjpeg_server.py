"""A stand-in for a camera that sends MJPEG over HTTP."""

from __future__ import annotations

import socket
import time

import simplejpeg

from runtime.sim.camera_server import CameraServer, picture

_ERRORS = {"not_found": "404 Not Found", "no_login": "401 Unauthorized"}


class MjpegServer(CameraServer):
    """multipart/x-mixed-replace, one part per picture. The fault "html" answers with a page."""

    scheme = "http"

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
        else:
            head = "HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=eva\r\n\r\n"
            client.sendall(head.encode())
            self._play(client)

    def _play(self, client: socket.socket) -> None:
        due, number = time.monotonic(), 0
        while True:
            time.sleep(max(0.0, due - time.monotonic()))
            if self.fault == "silent":
                client.recv(1)  # until it gives up
                return
            jpeg = simplejpeg.encode_jpeg(picture(number, *self.size), quality=90)
            if self.fault == "nonsense":
                jpeg = bytes(reversed(jpeg))
            part = f"--eva\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
            if self.fault == "torn":
                client.sendall(part + jpeg[: len(jpeg) // 2])
                return
            self._send_picture(client, part + jpeg + b"\r\n")
            number, due = number + 1, due + 1 / self.rate
            self.sent += 1
