"""No body is read that is longer than whoever sends it may send there; an e-stop is never refused for one."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys

import pytest
from django.conf import settings

from evaweb.console.body_limits import ANONYMOUS_LIMIT, USER_LIMIT, body_bound
from evaweb.plans.references import LARGEST
from evaweb.results.crates.limits import MOST_UPLOAD
from evaweb.serving.headers import DEFAULT_HEADERS
from tests.evaweb.console.test_serve import MANAGE, served
from tests.processes import PATIENCE_S

LAB = "bodies"  # its id
NAME = f"eva_session_{LAB}"
SESSION = [f"theme=dark; {settings.SESSION_COOKIE_NAME}=abc".encode()]
IDENTITY = {"id", "arguments"}  # of the sentences that have them
HUGE = 200_000_000


@pytest.mark.parametrize(
    ("path", "cookies", "authorized", "largest", "status"),
    [
        (b"/login/", [], False, ANONYMOUS_LIMIT, 413),
        (b"/login/", [b"eva_csrf=eva_session"], False, ANONYMOUS_LIMIT, 413),
        (b"/api/v1/trials/1/score", [], False, ANONYMOUS_LIMIT, 401),
        (b"/api/v1/trials/1/score", [], True, 256 * 1024, 413),
        (b"/api/v1/trials/1/score", SESSION, False, 256 * 1024, 413),
        (b"/api/v1/stations/bench-1/commands", SESSION, False, 256 * 1024, 413),
        (b"/api/v1/nowhere", SESSION, False, 64 * 1024, 413),
        (b"/result/trials/1/score", SESSION, False, USER_LIMIT, 413),
        (b"/admin/plans/plan/import/", SESSION, False, LARGEST + ANONYMOUS_LIMIT, 413),
        (b"/result/crates/import", SESSION, False, MOST_UPLOAD + ANONYMOUS_LIMIT, 413),
        (b"/admin/plans/plan/import/", [], True, USER_LIMIT, 413),
        (b"/admin/plans/plan/import/", [], False, ANONYMOUS_LIMIT, 413),
        (b"/api/v1/stations/bench-1/estop", [], False, ANONYMOUS_LIMIT, 0),
    ],
)
def test_how_much_may_be_sent(path, cookies, authorized, largest, status):
    found = body_bound(path, cookies, authorized)
    assert (found.largest, found.status) == (largest, status)


MADE = """
from django.contrib.auth.models import User
from django.test import Client
for name, role in (("alma", {"is_superuser": True}), ("vera", {})):
    client = Client()
    client.force_login(User.objects.create(username=name, **role))
    print(client.cookies["NAME"].value)
""".replace("NAME", NAME)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("bodies")
    (made / "lab_id").write_text(LAB)
    return made


@pytest.fixture(scope="module")
def port(folder):
    with served(folder) as (_, address):
        yield address["port"]


@pytest.fixture(scope="module")
def sessions(folder, port):
    """Of an administrator and of a viewer."""
    environment = os.environ | {"EVA_DATA_DIR": str(folder), "DJANGO_SETTINGS_MODULE": "evaweb.settings"}
    command = [sys.executable, MANAGE, "shell", "--verbosity", "0", "--command", MADE]
    made = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return made.stdout.split()


def asked(port, path, *headers, body=b"", method="POST"):
    """What is answered to these headers and as much of the body; read until the other side ends it."""
    lines = (f"{method} {path} HTTP/1.1", "Host: 127.0.0.1", "Connection: close", *headers, "", "")
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as connection:
        connection.sendall("\r\n".join(lines).encode() + body)
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    head, _, content = answer.partition(b"\r\n\r\n")
    status, *told = head.decode().lower().split("\r\n")
    assert {name.decode() for name, _ in DEFAULT_HEADERS} <= {line.partition(":")[0] for line in told}, (
        "as every answer has them"
    )
    return int(status.split()[1]), content


@pytest.mark.some(6)
@pytest.mark.slow
@pytest.mark.parametrize("rest", [False, True])
@pytest.mark.parametrize(
    ("path", "headers", "method", "status"),
    [
        ("{}", [f"Content-Length: {HUGE}", f"Cookie: {NAME}=abc"], "POST", 413),
        ("{}" + "x" * 20_000, [], "GET", 414),
        ("{}", ["X-Long: " + "x" * 20_000], "GET", 431),
        ("{}", [f"X-{number}: {'x' * 1000}" for number in range(30)], "GET", 431),
        ("{}", [f"X-{number}: x" for number in range(600)], "GET", 431),
        ("{}", ["no header"], "GET", 400),
        ("{}", ["X@Y: 1"], "GET", 400),
        ("{}nowhere", [], "PUT", 404),
        ("{}login", [], "GET", 301),
        ("{}login/", [], "DELETE", 403),
        ("{}static/css/base.css", [], "GET", 200),
        ("{}static/css/nothing.css", [], "GET", 404),
        ("{}%0a", [], "GET", 404),
        ("{}?%80", [], "GET", 302),
    ],
)
def test_whatever_is_refused_is_said_in_json_or_on_a_page_of_the_lab(
    port, rest, path, headers, method, status
):
    answered, content = asked(
        port, path.format("/api/v1/" if rest else "/"), *headers, "Accept: text/html", method=method
    )
    if rest and status not in (413, 414, 431, 400):
        assert (answered, set(json.loads(content)) - IDENTITY) == (404, {"error"})
    else:
        assert answered == status
        assert status < 400 or (
            set(json.loads(content)) - IDENTITY == {"error"} if rest else b"css/tokens.css" in content
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "header", "status"),
    [
        ("/api/v1/trials/1/score", "X-Nothing: 1", 401),
        ("/api/v1/trials/1/score", "Authorization: Bearer eva_x", 413),
        ("/login/", f"Cookie: {NAME}=abc", 413),
        ("/login/?next=/", "Expect: 100-continue", 413),
        ("/nowhere", "X-Nothing: 1", 413),
        ("/admin/plans/plan/import/", f"Cookie: {NAME}=abc", 403),
    ],
)
def test_what_is_too_long_is_refused_by_its_headers_alone(port, path, header, status):
    answered, content = asked(port, path, f"Content-Length: {HUGE}", header)
    assert answered == status
    assert (b"log in first" if status == 403 else b"the body is too long; allowed") in content
    if path.startswith("/api"):
        assert set(json.loads(content)) - IDENTITY == {"error"}


@pytest.mark.exhaustive
@pytest.mark.slow
def test_a_file_is_read_of_an_administrator_alone(port, sessions):
    length, path = USER_LIMIT + 1, "/admin/plans/plan/import/"
    admin, viewer = (f"Cookie: {NAME}={key}" for key in sessions)
    status, content = asked(port, path, f"Content-Length: {length}", viewer)
    assert (status, b"you are a viewer; this needs an admin" in content) == (403, True)
    form = "Content-Type: multipart/form-data; boundary=x"
    status, content = asked(port, path, f"Content-Length: {length}", form, admin, body=b"x" * length)
    assert (status, b"you are" in content) == (403, False)  # of Django, which has read it: it has no token


@pytest.mark.slow
def test_a_body_of_unsaid_length_is_refused_when_it_has_become_too_long(port):
    chunk = b"%x\r\n%s\r\n" % (ANONYMOUS_LIMIT, b"x" * ANONYMOUS_LIMIT)
    status, content = asked(port, "/login/", "Transfer-Encoding: chunked", body=chunk + b"1\r\nx\r\n")
    assert (status, b"the body is too long" in content) == (413, True)


@pytest.mark.slow
def test_what_is_short_enough_is_answered_by_the_page(port):
    body = b'{"success": true, "note": "' + b"x" * 1000 + b'"}'
    described = ("Content-Type: application/json", f"Content-Length: {len(body)}")
    status, content = asked(port, "/api/v1/trials/1/score", *described, body=body)
    assert (status, json.loads(content)["error"][:13]) == (401, "not logged in")


@pytest.mark.slow
@pytest.mark.parametrize("chunked", [False, True])
def test_an_e_stop_goes_on_without_what_is_too_long(port, chunked):
    body = b"x" * (ANONYMOUS_LIMIT + 1)
    kind = "Transfer-Encoding: chunked" if chunked else f"Content-Length: {len(body)}"
    sent = b"%x\r\n%s\r\n0\r\n\r\n" % (len(body), body) if chunked else body
    path = "/api/v1/stations/bench-1/" + ("estop" if chunked else "%65stop")
    status, content = asked(port, path, kind, "Content-Type: application/json", body=sent)
    assert (status, json.loads(content)["error"][:13]) == (401, "not logged in")


@pytest.mark.slow
def test_cookies_of_other_programs_keep_no_stop_from_being_heard(port):
    stop = "/api/v1/stations/bench-1/"
    for size, path, status in (
        (65_536, stop + "%65stop", 401),
        (65_536, stop + "commands", 401),
        (65_536, "/api/v1/me", 431),
        (200_000, stop + "estop", 431),
    ):
        status_now, content = asked(port, path, "Cookie: theme=" + "x" * size)
        assert (status_now, set(json.loads(content)) - IDENTITY) == (status, {"error"})
    assert asked(port, stop + "estop?" + "x" * 20_000)[0] == 414


@pytest.mark.slow
@pytest.mark.parametrize("method", [b"GET", b"POST"])
def test_what_follows_a_stop_over_its_connection_is_bounded_as_ever(port, method):
    head = b"%s %s HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: %d\r\nCookie: a=%s\r\n\r\n"
    body = b"{}" if method == b"POST" else b""
    sent = head % (method, b"/api/v1/stations/bench-1/estop", len(body), b"x" * 65_536) + body
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as connection:
        connection.sendall(sent + head % (b"GET", b"/api/v1/me", 0, b"x" * 20_000))
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    assert (answer.count(b"HTTP/1.1 401"), answer.count(b"HTTP/1.1 431")) == (1, 1)


@pytest.mark.exhaustive
@pytest.mark.slow
def test_a_line_that_is_no_request_is_refused_with_a_word(port):
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as connection:
        connection.sendall(b"nonsense\r\n")
        assert connection.recv(65536).startswith(b"HTTP/1.1 400 ")
