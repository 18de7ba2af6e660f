"""Static files: kept for good by their address, asked for anew by any other, and nothing beside them."""

import asyncio
import gzip

import brotli
import pytest
from django.conf import settings
from django.templatetags.static import static

from evaweb.serving.static_files import StaticFiles, digest_of

BASE = settings.BASE_DIR / "static" / "css" / "base.css"


async def elsewhere(scope, receive, send):
    await send({"type": "http.response.start", "status": 418, "headers": []})


@pytest.fixture
def ask():
    served = StaticFiles(elsewhere, settings.STATIC_DIGEST)

    def ask(path, method="GET", application=served, **headers):
        told = []

        async def send(event):
            told.append(event)

        given = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
        scope = {"type": "http", "path": path, "method": method, "headers": given}
        asyncio.run(application(scope, None, send))
        said = {name.decode(): value.decode() for name, value in told[0]["headers"]}
        return told[0]["status"], said, told[-1].get("body", b"")

    return ask


def test_what_a_page_names_is_kept_for_good_and_packed(ask):
    address = static("css/base.css")
    status, said, content = ask(address)
    assert (status, content, said["content-type"]) == (200, BASE.read_bytes(), "text/css; charset=utf-8")
    assert said["cache-control"] == "max-age=31536000, public, immutable"
    assert said["content-security-policy"] == "default-src 'self'"
    assert said["x-content-type-options"] == "nosniff"
    unpacking = {"br": brotli.decompress, "gzip": gzip.decompress}
    tags = {said["etag"]}
    for accepted, used in (("gzip, deflate, br", "br"), ("gzip;q=0.5, gzip", "gzip")):
        status, packed, small = ask(address, accept_encoding=accepted)
        assert (packed["content-encoding"], unpacking[used](small)) == (used, content)
        assert len(small) == int(packed["content-length"]) < len(content) / 2
        tags.add(packed["etag"])
    assert len(tags) == 3
    assert "content-encoding" not in ask(address, accept_encoding="gzip;q=0, identity")[1]
    assert ask(address, if_none_match=said["etag"])[::2] == (304, b"")
    assert ask(address, "HEAD")[::2] == (200, b"")


@pytest.mark.parametrize("before", ["", "0123456789abcdef/"])  # of another version, which is open somewhere
def test_at_any_other_address_a_browser_asks_each_time(ask, before):
    status, said, content = ask(f"/static/{before}css/base.css")
    assert (status, said["cache-control"], content) == (200, "max-age=0, public", BASE.read_bytes())


@pytest.mark.parametrize(
    "name", ["", "css", "css/", "none.css", "../manage.py", "/etc/passwd", "css/../../manage.py", "a\x00b"]
)
def test_all_else_is_asked_of_the_pages(ask, name):
    for address in (f"/static/{name}", f"/static/{settings.STATIC_DIGEST}/{name}", f"/statics/{name}"):
        assert ask(address)[0] == 418
    assert ask(static("css/base.css"), "POST")[0] == 418


def test_a_file_that_was_exchanged_under_a_running_web_is_not_kept_by_that_address(ask, monkeypatch):
    served = StaticFiles(elsewhere, settings.STATIC_DIGEST)
    monkeypatch.setattr(served, "_began", BASE.stat().st_mtime - 1)
    assert ask(static("css/base.css"), application=served)[1]["cache-control"] == "max-age=0, public"


def test_without_a_digest_each_is_read_anew(ask, tmp_path, settings):
    settings.STATICFILES_DIRS = [tmp_path]
    from django.contrib.staticfiles.finders import get_finder

    get_finder.cache_clear()
    try:
        served = StaticFiles(elsewhere, "")
        for content in (b"one", b"another"):
            (tmp_path / "it.js").write_bytes(content)
            _, said, sent = ask("/static/it.js", application=served)
            assert (sent, said["cache-control"]) == (content, "max-age=0, public")
    finally:
        get_finder.cache_clear()


def test_the_digest_is_that_of_names_and_contents(tmp_path):
    (tmp_path / "a.js").write_text("1")
    first = digest_of([tmp_path], "5.2")
    assert digest_of([tmp_path], "5.2") == first != digest_of([tmp_path], "5.3")
    (tmp_path / "a.js").rename(tmp_path / "b.js")
    assert digest_of([tmp_path], "5.2") != first
