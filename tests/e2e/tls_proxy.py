"""What docs/administrator.md has nginx do, in a thread: HTTPS in front of the web and of the process for stops."""

import asyncio
import re
import ssl
import threading
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from tests.processes import PATIENCE_S

NAME = "localhost"
_ESTOP = re.compile(rb"/api/v1/stations/[^/]+/estop$")
_ALIVE_S = 1.0  # what answers no connection for so long is gone


@contextmanager
def https(folder, web, stops):
    """The origin of a proxy that leads to the ports `web` and `stops`."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate(folder))
    loop, port = asyncio.new_event_loop(), []
    listens = threading.Event()

    async def serve():
        async def lead(reader, writer):
            with suppress(OSError, asyncio.IncompleteReadError, ssl.SSLError):
                await _lead(reader, writer, web, stops)
            writer.close()

        server = await asyncio.start_server(lead, "127.0.0.1", 0, ssl=context)
        port.append(server.sockets[0].getsockname()[1])
        listens.set()

    def run():
        loop.run_until_complete(serve())
        loop.run_forever()
        for task in asyncio.all_tasks(loop):
            task.cancel()
        loop.run_until_complete(asyncio.sleep(0))
        loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    assert listens.wait(PATIENCE_S)
    try:
        yield f"https://{NAME}:{port[0]}"
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()


async def _lead(reader, writer, web, stops):
    """One request and its answer, or a websocket; what the browser asks next it asks over another connection."""
    first, *lines = (await reader.readuntil(b"\r\n\r\n"))[:-4].split(b"\r\n")
    headers = [line.partition(b": ")[::2] for line in lines]
    upgrade = any(name.lower() == b"upgrade" for name, _ in headers)
    dropped = {b"x-forwarded-proto", b"x-forwarded-for"} | (set() if upgrade else {b"connection"})
    kept = [b": ".join(header) for header in headers if header[0].lower() not in dropped]
    said = [b"X-Forwarded-Proto: https", b"X-Forwarded-For: 192.0.2.7"]
    head = [first, *kept, *said] + ([] if upgrade else [b"Connection: close"])
    behind, answers = await _connected([stops, web] if _ESTOP.search(first.split()[1]) else [web])
    answers.write(b"\r\n".join([*head, b"", b""]))
    try:
        back = asyncio.create_task(_pump(behind, writer))
        forth = asyncio.create_task(_pump(reader, answers))
        await back
        forth.cancel()
    finally:
        answers.close()


async def _connected(ports):
    for port in ports[:-1]:
        with suppress(OSError, TimeoutError):
            return await asyncio.wait_for(asyncio.open_connection("127.0.0.1", port), _ALIVE_S)
    return await asyncio.open_connection("127.0.0.1", ports[-1])


async def _pump(source, sink):
    with suppress(OSError, ssl.SSLError):  # one end has gone
        while data := await source.read(65536):
            sink.write(data)
            await sink.drain()


def certificate(folder):
    """A file with a key and a certificate for NAME, signed by itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, NAME)])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(NAME)]), critical=False)
        .sign(key, hashes.SHA256())
    )
    plain = (serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    path = folder / "lab.pem"
    path.write_bytes(
        key.private_bytes(serialization.Encoding.PEM, *plain) + made.public_bytes(serialization.Encoding.PEM)
    )
    return path
