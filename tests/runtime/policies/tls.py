"""A server with TLS, and a certificate for it that nobody vouches for."""

from __future__ import annotations

import contextlib
import shutil
import ssl
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from runtime.core import msgpack_arrays
from runtime.core.tls import allow_two_threads

Certificate = tuple[Path, Path]  # and its key


def self_signed(folder: Path) -> Certificate:
    """Of localhost, signed by itself; skips where openssl is missing."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl, which makes the certificate, is not installed")
    made, key = folder / "cert.pem", folder / "key.pem"
    subprocess.run(
        [
            *(
                "openssl",
                "req",
                "-x509",
                "-newkey",
                "ec",
                "-pkeyopt",
                "ec_paramgen_curve:prime256v1",
                "-nodes",
            ),
            *("-days", "2", "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"),
            *("-keyout", str(key), "-out", str(made)),
        ],
        check=True,
        capture_output=True,
    )
    return made, key


@contextlib.contextmanager
def encrypted(certificate: Certificate) -> Iterator[str]:
    """A websocket server with TLS that answers with rows; its address."""
    context = allow_two_threads(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER))
    context.load_cert_chain(*certificate)

    def converse(connection: ServerConnection) -> None:
        assert connection.request is not None
        connection.send(msgpack_arrays.pack({"name": connection.request.path}))
        for _ in connection:
            connection.send(msgpack_arrays.pack({"actions": [], "error": "unused"}))

    def admit(connection: ServerConnection, request: Request) -> Response | None:
        return connection.respond(200, "OK\n") if request.path == "/healthz" else None

    with serve(converse, "127.0.0.1", 0, ssl=context, process_request=admit) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"wss://localhost:{server.socket.getsockname()[1]}/lab/policy?model=a"
        server.shutdown()
        thread.join()
