"""The web process: announced, reached, ended."""

from __future__ import annotations

import asyncio
import json
import os
import resource
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import urllib.error
import urllib.request
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest
from autobahn.exception import Disconnected

from evaweb.console.server import _address, _Server
from evaweb.serving.listeners import PortInUseError, open_listener
from tests import migrated
from tests.processes import PATIENCE_S, eventually

MANAGE = Path(__file__).parents[3] / "manage.py"


class _Left:
    """What daphne has for the connection of a page that has left."""

    def handle_reply(self, message):
        raise Disconnected("Attempt to send on a closed protocol")


def test_what_is_sent_to_a_page_that_has_left_is_no_error():
    server = object.__new__(_Server)
    leaving = _Left()
    server.connections = {leaving: {}}
    asyncio.run(server.handle_reply(leaving, {"type": "websocket.send", "text": "late"}))


@contextmanager
def served(folder, *options, path=None, command="serve", program=MANAGE):
    """A web process on a free port, or that for stops, and what it announced; killed where the test forgot it."""
    environment = os.environ | {"EVA_DATA_DIR": str(folder), "DJANGO_SETTINGS_MODULE": "evaweb.settings"}
    if path is not None:
        environment["PYTHONPATH"] = str(path)
    shutil.copy(_template().database, folder / "eva.sqlite3")
    process = subprocess.Popen(
        [sys.executable, program, command, "--port", "0", *options],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process, json.loads(process.stdout.readline())
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


def test_a_taken_port_is_an_error_that_names_the_option():
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(
            PortInUseError,
            match=rf"cannot listen on 127.0.0.1:{port}: .* with --host, or another port with --port",
        ):
            open_listener("127.0.0.1", port)


def test_an_address_of_another_machine_is_an_error_too():
    with pytest.raises(PortInUseError, match=r"cannot listen on 192\.0\.2\.1:0"):
        open_listener("192.0.2.1", 0)


@pytest.mark.parametrize(("host", "shown"), [("127.0.0.1", "127.0.0.1"), ("0.0.0.0", "127.0.0.1")])
def test_what_is_announced_can_be_opened(host, shown):
    with open_listener(host, 0) as listener:
        address = _address(listener)
        assert address["url"] == f"http://{shown}:{address['port']}"
        socket.create_connection((shown, address["port"])).close()


@pytest.mark.exhaustive
@pytest.mark.slow
def test_it_serves_and_ends_with_its_lifeline(tmp_path):
    with served(tmp_path, "--lifeline") as (process, address):
        with urllib.request.urlopen(f"{address['url']}/healthz") as answer:
            assert answer.read() == b"ok\n"
        process.stdin.close()
        assert process.wait(PATIENCE_S) == 0


@pytest.mark.exhaustive
@pytest.mark.slow
def test_it_gives_way_once_it_serves(tmp_path):
    own = os.getpriority(os.PRIO_PROCESS, 0)
    with served(tmp_path, "--nice", "3") as (process, _):
        threads = [int(thread.name) for thread in Path(f"/proc/{process.pid}/task").iterdir()]
        found = {os.getpriority(os.PRIO_PROCESS, thread) for thread in threads}
        assert found == {min(own + 3, 19)}


@pytest.mark.exhaustive
@pytest.mark.slow
def test_it_ends_when_it_is_told(tmp_path):
    with served(tmp_path) as (process, address):
        assert address["port"] > 0
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0


@pytest.mark.exhaustive
@pytest.mark.slow
def test_connections_that_ask_for_nothing_keep_nobody_out_and_are_closed(tmp_path):
    """Twice as many as the process had files for before its limit was raised."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 4096), hard))
    limited = f"import resource; resource.setrlimit(resource.RLIMIT_NOFILE, (256, {min(hard, 2048)}))"
    (tmp_path / "sitecustomize.py").write_text(limited)
    half_open = []
    try:
        with served(tmp_path, path=tmp_path) as (_, address):
            for _ in range(1100):
                half_open.append(socket.create_connection(("127.0.0.1", address["port"]), timeout=PATIENCE_S))
                half_open[-1].sendall(b"POST /api/v1/stations/bench/estop HTTP/1.1\r\nHost: ")
            request = urllib.request.Request(
                f"{address['url']}/api/v1/stations/bench/estop", b"{}", method="POST"
            )
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(request, timeout=PATIENCE_S)
            assert (refused.value.code, "error" in json.load(refused.value)) == (401, True)
            with pytest.raises(ConnectionResetError):  # the oldest has made place
                half_open[0].recv(1)
    finally:
        for one in half_open:
            one.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.exhaustive
@pytest.mark.slow
def test_the_process_for_stops_answers_says_where_it_is_and_ends_with_its_lifeline(tmp_path):
    with served(tmp_path, "--web-port", "8000", "--lifeline", command="stops") as (process, address):
        said = tmp_path / "stops.json"
        assert json.loads(said.read_bytes()) == {"port": address["port"], "web_port": 8000}
        estop = f"{address['url']}/api/v1/stations/bench/estop"
        upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Key": "x"}
        asked = ((estop, {}, 401), (f"{address['url']}/login/", {}, 404), (address["url"], upgrade, 404))
        for url, headers, status in asked:
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=PATIENCE_S)
            assert (refused.value.code, next(iter(json.load(refused.value)))) == (status, "error")
        process.stdin.close()
        assert process.wait(PATIENCE_S) == 0
        assert not said.exists()


@pytest.mark.slow
@pytest.mark.parametrize("command", ["serve", "stops"])
def test_an_e_stop_whose_sender_dies_in_the_middle_of_its_body_is_pressed(tmp_path, command):
    (tmp_path / "stations" / "bench").mkdir(parents=True)  # else its presses are not written down
    with served(tmp_path, command=command) as (_, address):
        token = _template().token
        head = "POST /api/v1/stations/bench/{} HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {}\r\n"
        body = b'Content-Length: 99\r\n\r\n{"why": "half of'
        for path in ("commands", "estop"):
            with socket.create_connection(("127.0.0.1", address["port"]), PATIENCE_S) as dies:
                dies.sendall(head.format(path, token).encode() + body)
        eventually(lambda: _presses(tmp_path) == [("estop", {"why": "pressed"})], "it is pressed")


@pytest.mark.some(1)
@pytest.mark.slow
@pytest.mark.parametrize("command", ["serve", "stops"])
def test_no_type_and_no_length_of_its_body_refuses_a_press(tmp_path, command):
    forms = ("multipart/form-data", "multipart/form-data; boundary=x", "application/x-www-form-urlencoded")
    short, long = b'{"kind": "estop"}', b'{"kind": "%b", "args": {"why": "' + b"x" * 300_000 + b'"}}'
    sent = [(path, form, short) for path in ("estop", "commands") for form in forms]
    sent += [(path, "application/json", long % b"estop") for path in ("estop", "commands")]
    with served(tmp_path, command=command) as (_, address):
        token = _template().token
        described = [_asked_as(token, address["url"], *one) for one in sent]
        chunked = _asked_as(token, address["url"], "commands", "text/plain", iter([long % b"estop"]))
        other = _asked_as(token, address["url"], "commands", "application/json", long % b"home")
    assert all(b'"uuid"' in said and status not in (400, 413) for status, said in [*described, chunked])
    assert other[0] == 413


def _asked_as(token, url, path, kind, body):
    headers = {"Authorization": f"Bearer {token}", "Content-Type": kind}
    where = f"{url}/api/v1/stations/bench/{path}"
    try:
        with urllib.request.urlopen(
            urllib.request.Request(where, body, headers), timeout=PATIENCE_S
        ) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as refused:
        with refused:
            return refused.code, refused.read()


@dataclass(frozen=True)
class _Template:
    """A database that has the station `bench`, and the token of an account of its own."""

    database: Path
    token: str


@cache
def _template():
    """Made once: it takes longer than what is tried on copies of it."""
    folder = Path(os.environ["EVA_DATA_DIR"], "template")
    migrated.copy(folder)
    made = subprocess.run(
        [sys.executable, MANAGE, "shell", "-v0", "-c", _MADE],
        env=os.environ | {"EVA_DATA_DIR": str(folder), "DJANGO_SETTINGS_MODULE": "evaweb.settings"},
        check=True,
        capture_output=True,
        text=True,
    )
    return _Template(folder / "eva.sqlite3", made.stdout.strip())


_MADE = """
from django.contrib.auth.models import User
from evaweb.api.tokens import create_token
from evaweb.stations.models import Station
Station.objects.create(name="bench", robot="agilex_piper")
print(create_token(user=User.objects.create(username="program"), name="tests"))
"""


def _presses(folder):
    with closing(sqlite3.connect(folder / "eva.sqlite3")) as database:
        rows = database.execute("SELECT kind, args FROM stations_command").fetchall()
    return [(kind, json.loads(args)) for kind, args in rows]
