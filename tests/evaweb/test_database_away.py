"""A PostgreSQL that refuses connections, and one that takes them and says nothing."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from uuid import uuid4

import pytest

from tests.processes import PATIENCE_S

AWAY = Path(__file__).parent / "away.py"
TOKEN = {"authorization": f"Bearer eva_{'x' * 43}"}
PAGE = {"cookie": f"eva_session_away={'a' * 32}", "accept": "text/html"}
BROWSER = {"cookie": f"eva_session_away={'a' * 32}; eva_csrf_away={'b' * 32}", "x-csrftoken": "b" * 32}


@pytest.fixture(params=["refuses", "hangs"])
def database(request):
    """Where it is."""
    with socket.create_server(("127.0.0.1", 0)) as server:  # a client is connected before anybody accepts it
        port = server.getsockname()[1]
        if request.param == "refuses":
            server.close()
        yield f"postgres://eva:x@127.0.0.1:{port}/eva"


@pytest.fixture
def ask(database, tmp_path):
    """The answers of the web to some questions."""

    (tmp_path / "lab_id").write_text("away")

    def asked(*questions):
        environment = os.environ | {"DATABASE_URL": database, "EVA_DATA_DIR": str(tmp_path)}
        paths = [str(AWAY.parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment["PYTHONPATH"] = os.pathsep.join(paths)
        command = [sys.executable, AWAY, json.dumps(questions)]
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=4 * PATIENCE_S, check=True
        )
        return [json.loads(line) for line in done.stdout.splitlines()]

    return asked


@pytest.mark.slow
def test_an_e_stop_is_obeyed_and_everything_else_is_said_in_json(ask):
    pytest.importorskip("psycopg")
    command = {"uuid": str(uuid4()), "page": "p"}
    questions = [
        ("POST", "/api/v1/stations/bench/estop", "{}", TOKEN),
        ("POST", "/api/v1/stations/bench/estop", "{}", BROWSER),
        ("POST", "/api/v1/stations/bench/commands", json.dumps({**command, "kind": "halt"}), TOKEN),
        ("POST", "/api/v1/stations/bench/commands", json.dumps({**command, "kind": "home"}), TOKEN),
        ("POST", "/api/v1/stations/bench/commands", json.dumps({**command, "kind": "home"}), BROWSER),
        ("GET", "/api/v1/me", "", TOKEN),
        ("GET", "/api/v1/me", "", BROWSER),
        ("GET", "/api/v1/me", "", {"host": "evil.example"}),
    ]
    answers = ask(*questions)
    assert [answer["status"] for answer in answers] == [409, 409, 503, 503, 503, 503, 503, 400]
    assert all(answer["type"].startswith("application/json") for answer in answers)
    for pressed in answers[:2]:
        assert "bench is not running" in json.loads(pressed["body"])["reason"], "it went to the station"
    for refused in answers[2:]:
        assert list(json.loads(refused["body"])) == ["error"]


@pytest.mark.slow
def test_pages_say_what_still_works(ask):
    pytest.importorskip("psycopg")
    paths = ("/", "/login/", "/result/", "/stations/bench/eval/", "/admin/", "/nowhere")
    *pages, alive = ask(*(("GET", path, "", PAGE) for path in (*paths, "/healthz")))
    assert [page["status"] for page in pages] == [503] * len(paths)
    for page in pages:
        assert "the database is busy or gone: it was not changed, try again" in page["body"]
        assert "python -m runtime.ctl STATION estop" in page["body"]
        assert "127.0.0.1" not in page["body"], "where the database is, strangers are not told"
    assert (alive["status"], alive["body"]) == (200, "ok\n")
