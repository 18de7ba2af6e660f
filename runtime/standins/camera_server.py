"""Base class of stand-in network cameras, which serve images at a rate on a port, with faults on demand."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from abc import ABC, abstractmethod

import numpy as np

from runtime.core.types import UInt8

_TRICKLE_S = 0.02  # between two bytes
FAULTS = {
    "mute": "accepts and says nothing",
    "garbage": "answers with bytes that are no video",
    "not_found": "answers that there is nothing there",
    "no_login": "answers that it wants a login",
    "silent": "plays, and then sends nothing more",
    "trickle": "plays one byte at a time",
    "torn": "ends in the middle of a picture",
    "nonsense": "goes on with pictures that nobody can decode",
}


def picture(number: int, width: int, height: int) -> UInt8:
    """Return an RGB image [height, width, 3]: red on the left, blue on the right, with a white bar that grows per
    image.
    """
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 2, 0] = 220
    image[:, width // 2 :, 2] = 220
    image[-height // 8 :, : (number * 8) % width + 1] = 255
    return image


class CameraServer(ABC):
    """Server of one camera on loopback, with a thread per client.

    `size`, `rate` and `fault` may be changed at any time.
    """

    scheme: str

    def __init__(self, width: int = 160, height: int = 120, rate: float = 30.0, port: int = 0) -> None:
        self.size = (width, height)
        self.rate = rate
        self.fault = ""
        self.sent = 0  # images sent to all clients
        self._port = port
        self._listening: socket.socket | None = None
        self._clients: set[socket.socket] = set()
        self._lock = threading.Lock()

    @property
    def url(self) -> str:
        return f"{self.scheme}://127.0.0.1:{self._port}/camera"

    def start(self) -> str:
        """Listen, on the same port as before if there was one; return the URL.

        Raises:
            OSError: If the port is in use.
        """
        self._listening = socket.create_server(("127.0.0.1", self._port))
        self._port = self._listening.getsockname()[1]
        threading.Thread(target=self._accept, args=(self._listening,), daemon=True).start()
        return self.url

    def close(self) -> None:
        """Stop listening and close all connections; `start` may be called again."""
        listening, self._listening = self._listening, None
        if listening is not None:
            with contextlib.suppress(OSError):  # wakes accept
                listening.shutdown(socket.SHUT_RDWR)
            listening.close()
        self.hang_up()

    def hang_up(self) -> None:
        """Close all connections."""
        with self._lock:
            clients = list(self._clients)
        for client in clients:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def _accept(self, listening: socket.socket) -> None:
        while True:
            try:
                client, _ = listening.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with self._lock:
            self._clients.add(client)
        try:
            if self.fault == "mute":
                while client.recv(4096):
                    pass
            elif self.fault == "garbage":
                client.sendall(b"SSH-2.0-OpenSSH_9.2\r\n" * 50)
            else:
                self._speak(client)
        except OSError:
            return  # the client has disconnected, or `hang_up` was called
        finally:
            with self._lock:
                self._clients.discard(client)
            client.close()

    def _send_picture(self, client: socket.socket, data: bytes) -> None:
        """Send an encoded image to a client, byte by byte with the fault "trickle"."""
        if self.fault != "trickle":
            client.sendall(data)
            return
        for byte in data:
            client.sendall(bytes([byte]))
            time.sleep(_TRICKLE_S)

    @abstractmethod
    def _speak(self, client: socket.socket) -> None:
        """Send images to one client until either side ends the connection.

        Raises:
            OSError: If the connection is lost.
        """
