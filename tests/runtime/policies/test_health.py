from __future__ import annotations

import contextlib
import socket
import ssl
import threading
from collections.abc import Iterator

import pytest
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from runtime.core.clock import MonotonicClock
from runtime.core.errors import PolicyError, PolicyLostError
from runtime.policies import openpi
from runtime.policies.health import require_healthy
from runtime.policies.openpi import OpenpiPolicy
from runtime.standins.openpi_server import Behaviour, OpenpiServer
from tests.processes import joined
from tests.runtime.policies.peers import FRANKA, seen
from tests.runtime.policies.tls import Certificate, encrypted, self_signed


@contextlib.contextmanager
def saying(*pieces: bytes) -> Iterator[str]:
    """A TCP server that says these pieces to whoever asks, and keeps the connection; its address."""
    held: list[socket.socket] = []

    def accept() -> None:
        with contextlib.suppress(OSError):
            while True:
                peer = listener.accept()[0]
                held.append(peer)
                asked.append(peer.recv(65536))
                for piece in pieces:
                    peer.sendall(piece)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=accept)
        thread.start()
        yield f"ws://127.0.0.1:{listener.getsockname()[1]}/v1/policy"
        listener.shutdown(socket.SHUT_RDWR)
        thread.join()
    for peer in held:
        peer.close()


asked: list[bytes] = []


def test_a_server_that_is_well_is_asked_at_its_own_port_with_the_key() -> None:
    asked.clear()
    with saying(b"HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\nOK\n") as url:
        require_healthy(url, "/healthz", {"Authorization": "Api-Key secret"}, 5.0)
    request = asked[0].decode().split("\r\n")
    assert request[0] == "GET /healthz HTTP/1.1"
    assert f"Host: {url.split('/')[2]}" in request
    assert "Authorization: Api-Key secret" in request


@pytest.mark.parametrize(
    ("pieces", "lost", "says"),
    [
        ([b"HTTP/1.1 503 Service Unavailable\r\n\r\n"], True, "is not well: /healthz says HTTP 503"),
        ([b"HTTP/1.1 404 Not", b" Found\r\n\r\n"], False, "HTTP 404 Not Found, expected 200: another server"),
        ([b"SSH-2.0-OpenSSH_9.6\r\n"], False, "that is not a web server, it answers b'SSH-2.0"),
        ([b"HTTP/1.1 2"], True, r"gave no answer within 0\.2 s"),
        ([], True, r"gave no answer within 0\.2 s"),
    ],
)
def test_what_is_not_well_is_told_from_what_is_no_policy_server(
    pieces: list[bytes], lost: bool, says: str
) -> None:
    with saying(*pieces) as url, pytest.raises(PolicyError, match=says) as raised:
        require_healthy(url, "/healthz", {}, 0.2)
    assert isinstance(raised.value, PolicyLostError) == lost


def test_nobody_at_the_port_is_said_so() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(PolicyLostError, match="no policy server listens"):
        require_healthy(f"ws://127.0.0.1:{port}", "/healthz", {}, 5.0)


def test_a_server_that_hangs_up_is_lost() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def hang_up() -> None:
            peer = listener.accept()[0]
            peer.recv(65536)
            peer.close()

        thread = threading.Thread(target=hang_up)
        thread.start()
        with pytest.raises(
            PolicyLostError, match="/healthz gave no answer, the connection was closed at once"
        ):
            require_healthy(f"ws://127.0.0.1:{listener.getsockname()[1]}", "/healthz", {}, 5.0)
        thread.join()


def built(url: str, **settings: str) -> OpenpiPolicy:
    config = openpi.Config(url=url, connect_deadline=60.0, **settings)  # type: ignore[arg-type]
    return openpi.build(config, FRANKA, MonotonicClock(), 30.0)


def test_a_policy_asks_for_it_before_it_connects_where_that_is_configured() -> None:
    with contextlib.closing(OpenpiServer(FRANKA, Behaviour())) as server:
        url = str(server.start()["url"])
        with contextlib.closing(built(url, health_path="/healthz")) as policy:
            assert policy.connect().name == "stand-in"
    paths = []

    def admit(connection: ServerConnection, request: Request) -> Response | None:
        paths.append(request.path)
        return connection.respond(503, "loading\n") if request.path == "/health" else None

    with serve(lambda connection: None, "127.0.0.1", 0, process_request=admit) as server_:
        thread = threading.Thread(target=server_.serve_forever)
        thread.start()
        port = server_.socket.getsockname()[1]
        with (
            contextlib.closing(built(f"ws://127.0.0.1:{port}/policy", health_path="/health")) as policy,
            pytest.raises(PolicyLostError, match="/health says HTTP 503"),
        ):
            policy.connect()
        server_.shutdown()
        thread.join()
    assert paths == ["/health"]  # the websocket is not tried at a server that is not well


# TLS


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Certificate:
    return self_signed(tmp_path_factory.mktemp("tls"))


def test_a_server_with_tls_and_a_path_is_reached(
    certificate: Certificate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate[0]))
    with (
        encrypted(certificate) as url,
        contextlib.closing(built(url, health_path="/healthz")) as policy,
    ):
        assert policy.connect().name == "/lab/policy?model=a"


def test_a_server_that_shakes_hands_by_tls_and_then_says_nothing_is_given_up(
    certificate: Certificate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate[0]))
    context, kept = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), []
    context.load_cert_chain(*certificate)
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def serve_mutely() -> None:
            found, _ = listening.accept()
            kept.append(context.wrap_socket(found, server_side=True))

        thread = threading.Thread(target=serve_mutely, daemon=True)
        thread.start()
        url = f"wss://localhost:{listening.getsockname()[1]}"
        config = openpi.Config(url=url, connect_deadline=0.6)
        with (
            contextlib.closing(openpi.build(config, FRANKA, MonotonicClock(), 30.0)) as policy,
            pytest.raises(PolicyLostError),
        ):
            policy.connect()
        joined(thread)
    kept[0].close()


@pytest.mark.parametrize("health", [{}, {"health_path": "/healthz"}])
def test_a_certificate_that_nobody_vouches_for_is_refused(
    certificate: Certificate, health: dict[str, str]
) -> None:
    with (
        encrypted(certificate) as url,
        contextlib.closing(built(url, **health)) as policy,
        pytest.raises(PolicyError, match=r"no encrypted connection .*certificate") as raised,
    ):
        policy.connect()
    assert not isinstance(raised.value, PolicyLostError)


def test_tls_where_there_is_none_is_said_so() -> None:
    with contextlib.closing(OpenpiServer(FRANKA, Behaviour())) as server:
        port = server.start()["port"]
        with (
            contextlib.closing(built(f"wss://127.0.0.1:{port}")) as policy,
            pytest.raises(PolicyError, match="no encrypted connection"),
        ):
            policy.infer(seen(FRANKA))
