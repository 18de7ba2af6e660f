"""The web process: announced, reached, ended."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import pytest

from evaweb.console.server import PortTaken, _address, listen

MANAGE = Path(__file__).parents[3] / "manage.py"


@contextmanager
def served(folder, *options):
    """A web process on a free port and what it announced; killed where the test forgot it."""
    environment = os.environ | {"EVA_DATA_DIR": str(folder), "DJANGO_SETTINGS_MODULE": "evaweb.settings"}
    subprocess.run([sys.executable, MANAGE, "migrate", "-v0"], env=environment, check=True)
    process = subprocess.Popen(
        [sys.executable, MANAGE, "serve", "--port", "0", *options],
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
        with pytest.raises(PortTaken, match=rf"cannot listen on 127.0.0.1:{port}: .* with --host, --port"):
            listen("127.0.0.1", port)


def test_an_address_of_another_machine_is_an_error_too():
    with pytest.raises(PortTaken, match=r"cannot listen on 192\.0\.2\.1:0"):
        listen("192.0.2.1", 0)


@pytest.mark.parametrize(("host", "shown"), [("127.0.0.1", "127.0.0.1"), ("0.0.0.0", "127.0.0.1")])
def test_what_is_announced_can_be_opened(host, shown):
    with listen(host, 0) as listener:
        address = _address(listener)
        assert address["url"] == f"http://{shown}:{address['port']}"
        socket.create_connection((shown, address["port"])).close()


@pytest.mark.slow
def test_it_serves_and_ends_with_its_lifeline(tmp_path):
    with served(tmp_path, "--lifeline") as (process, address):
        with urllib.request.urlopen(f"{address['url']}/healthz") as answer:
            assert answer.read() == b"ok\n"
        process.stdin.close()
        assert process.wait(20) == 0


@pytest.mark.slow
def test_it_ends_when_it_is_told(tmp_path):
    with served(tmp_path) as (process, address):
        assert address["port"] > 0
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
