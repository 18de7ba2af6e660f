"""Where the process for stops listens, and which pages are told of it."""

from __future__ import annotations

import pytest

from evaweb.serving.origins import is_own_origin, origin_at_port, scheme_of
from evaweb.serving.stop_port import StopPort, origin_for, read_stop_port


@pytest.fixture(autouse=True)
def folder(settings, tmp_path):
    settings.DATA_DIR = tmp_path
    settings.ALLOWED_HOSTS = ["*"]
    return tmp_path


def asked(rf, host, port="8000"):
    return rf.get("/", headers={"host": host}, SERVER_PORT=port)


def test_a_page_of_the_webs_own_port_is_told_as_long_as_it_listens(rf):
    assert origin_for(asked(rf, "lab:8000")) == ""
    listens = StopPort(8001, 8000)
    listens.start()
    assert read_stop_port() == listens
    assert origin_for(asked(rf, "lab:8000")) == "http://lab:8001"
    assert origin_for(asked(rf, "[::1]:8000")) == "http://[::1]:8001"
    listens.end()
    assert (read_stop_port(), origin_for(asked(rf, "lab:8000"))) == (None, "")


@pytest.mark.parametrize("host", ["lab.example.org", "lab.example.org:443", "lab:8002"])
def test_a_page_that_came_through_a_proxy_or_of_another_web_is_told_of_none(rf, host):
    StopPort(8001, 8000).start()
    assert origin_for(asked(rf, host)) == ""
    assert origin_for(asked(rf, "lab:8000", port="8002")) == ""


def test_a_lab_with_https_never_makes_a_page_call_plain_http(rf, settings):
    StopPort(8001, 8000).start()
    settings.SESSION_COOKIE_SECURE = True
    assert origin_for(asked(rf, "lab:8000")) == ""


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b'{"port": "x", "web_port": 1}', b"\xff"])
def test_a_file_that_says_nothing_is_none(folder, content):
    (folder / "stops.json").write_bytes(content)
    assert read_stop_port() is None


def test_port_80_is_not_written():
    assert origin_at_port("lab", 80, 8001) == "http://lab:8001"
    assert is_own_origin("http://lab", "lab:8001", "http", 80)


@pytest.mark.parametrize(
    ("origin", "ours"),
    [
        ("http://lab:8000", True),
        ("http://lab:8001", True),
        ("https://lab:8001", False),
        ("https://lab:8000", False),
        ("http://lab:8002", False),
        ("http://other:8000", False),
        ("http://lab:8000.evil.test", False),
        ("http://lab:x", False),
        ("null", False),
        ("", False),
    ],
)
def test_ours_are_the_webs_port_of_the_same_host_and_its_own(origin, ours):
    assert is_own_origin(origin, "lab:8001", "http", 8000) is ours


@pytest.mark.parametrize(
    ("scheme", "forwarded", "origin", "ours"),
    [
        ("ws", [], "http://lab", True),
        ("ws", [], "https://lab", False),
        ("wss", [], "https://lab", True),
        ("wss", [], "http://lab", False),
        ("ws", [b"https"], "https://lab", True),
        ("ws", [b"https, http"], "https://lab", True),
        ("ws", [b"https"], "http://lab", False),
        ("ws", [b"http"], "https://lab", False),
    ],
)
def test_a_page_has_the_scheme_that_its_proxy_says(settings, scheme, forwarded, origin, ours):
    settings.SECURE_PROXY_SSL_HEADER = ("HTTP_X_FORWARDED_PROTO", "https")
    scope = {"scheme": scheme, "headers": [(b"x-forwarded-proto", value) for value in forwarded]}
    assert is_own_origin(origin, "lab", scheme_of(scope)) is ours
    settings.SECURE_PROXY_SSL_HEADER = None  # nobody's word
    assert scheme_of(scope) == {"ws": "http", "wss": "https"}[scheme]
    settings.CSRF_TRUSTED_ORIGINS = [origin]
    assert is_own_origin(origin, "lab", scheme_of(scope))


def test_a_station_page_may_connect_there_and_knows_the_address(client, ann, live):
    StopPort(8001, 80).start()
    client.force_login(ann)
    shown = client.get(f"/stations/{live.name}/debug/")
    assert 'data-stops="http://testserver:8001"' in shown.content.decode()
    assert "connect-src 'self' http://testserver:8001;" in shown.headers["content-security-policy"] + ";"
    StopPort(8001, 80).end()
    shown = client.get(f"/stations/{live.name}/debug/")
    assert 'data-stops=""' in shown.content.decode()
    assert "8001" not in shown.headers["content-security-policy"]
