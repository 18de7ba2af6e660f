"""The process for stops under a crowd of credentials that somebody makes up, over its real port."""

from __future__ import annotations

import http.client
import os
import secrets
import socket
import subprocess
import sys
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from threading import Event, Thread

import pytest

from tests.evaweb.console.test_serve import MANAGE, served
from tests.evaweb.stand_in import FakeStation
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
PATIENT = Path(__file__).with_name("patient.py")
BENCH, LAB = "bench", "crowd"
PATH = f"/api/v1/stations/{BENCH}/estop"
CROWDED, QUIET = "127.0.0.2", "127.0.0.1"
AT_ONCE = 80
MADE = """
from django.contrib.auth.models import User
from django.test import Client
for name in ("ann", "bob", "cyd"):
    client = Client()
    client.force_login(User.objects.create(username=name))
    print(client.session.session_key)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("crowd")
    (made / "lab_id").write_text(LAB)
    return made


@pytest.fixture(scope="module")
def port(folder):
    with served(folder, command="stops", program=PATIENT, path=MANAGE.parent) as (_, address):
        yield address["port"]


@pytest.fixture(scope="module")
def sessions(folder, port):
    environment = os.environ | {"EVA_DATA_DIR": str(folder), "DJANGO_SETTINGS_MODULE": "evaweb.settings"}
    command = [sys.executable, MANAGE, "shell", "--verbosity", "0", "--command", MADE]
    made = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return made.stdout.split()


@pytest.fixture
def bench(folder):
    made = FakeStation(folder, BENCH)
    yield made
    made.end()


def press(port, session, address):
    """The status of a press by that session from that address."""
    connection = http.client.HTTPConnection(QUIET, port, timeout=4 * PATIENCE_S, source_address=(address, 0))
    connection.request("POST", PATH, "{}", {"Cookie": f"eva_session_{LAB}={session}"})
    status = connection.getresponse().status
    connection.close()
    return status


def hammer(port, over, answers):
    """Press by so many made-up sessions at once, again and again, from one address."""
    while not over.is_set():
        with ExitStack() as opened:
            presses = []
            for _ in range(AT_ONCE):
                one = socket.create_connection((QUIET, port), PATIENCE_S, source_address=(CROWDED, 0))
                presses.append(opened.enter_context(one))
                said = (
                    f"POST {PATH} HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\nConnection: close\r\n"
                )
                one.sendall(f"{said}Cookie: eva_session_{LAB}={secrets.token_hex(16)}\r\n\r\n{{}}".encode())
            answers.update(one.recv(12).decode() for one in presses)


@pytest.mark.exhaustive
def test_presses_of_people_come_through_and_those_of_the_crowd_are_refused(port, sessions, bench):
    ann, bob, cyd = sessions
    assert press(port, ann, CROWDED) == 200, "and is remembered"
    over, answers = Event(), Counter()
    crowd = Thread(target=hammer, args=(port, over, answers))
    crowd.start()
    try:
        eventually(lambda: sum(answers.values()) >= AT_ONCE, "the crowd is at it", 3 * PATIENCE_S)
        pressed = [
            press(port, session, address)
            for _ in range(2)
            for session, address in ((ann, CROWDED), (bob, QUIET), (cyd, CROWDED))
        ]
    finally:
        over.set()
        crowd.join()
    assert pressed == [200] * 6
    assert {one.user for one in bench.pressed} == {"ann", "bob", "cyd"}
    assert set(answers) == {"HTTP/1.1 401"}
