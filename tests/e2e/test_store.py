"""Replay in a real browser of a lab whose videos are in an S3-compatible store."""

import time

import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import WIDE, Demo
from tests.evaweb.s3_server import Server, why_no_server
from tests.processes import PATIENCE_S, eventually
from tests.runtime.quality import built

pytestmark = pytest.mark.slow
PLAYS = "all => all.length > 0 && all.every((video) => video.readyState >= 2 && !video.error)"


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    if why := why_no_server():
        pytest.skip(why)
    folder = tmp_path_factory.mktemp("stored")
    server = Server(folder)
    bucket = server.bucket()
    given = {"EVA_STORE": f"s3://lab/{bucket.prefix}", "EVA_STORE_ENDPOINT": bucket.endpoint}
    lab = Demo(folder, **given, EVA_STORE_KEY=bucket.key, EVA_STORE_SECRET=bucket.secret)
    try:
        lab.start().people()
        lab.server = server
        yield lab
        assert lab.end() == 0
    finally:
        server.close()


def test_videos_play_from_the_store_as_the_policy_of_pages_allows(browser, stored):
    root = stored.data / "episodes"
    uuid = built.record_of(root, "agilex_piper", started_wall=time.time(), station="bench-1").name
    stored.python("from evaweb.episodes.reconcile import reconcile; reconcile()")
    preview = stored.data / "previews" / uuid
    eventually(
        lambda: (preview / "stored.json").exists() and not list(preview.glob("*.mp4")),
        "the store",
        3 * PATIENCE_S,
    )
    page = BenchPage(browser, stored, "ann", WIDE)
    try:
        asked = []
        page.page.on("request", lambda request: asked.append(request.url))
        page.open(f"/replay/{uuid}/")
        eventually(lambda: page.page.eval_on_selector_all("video[data-camera]", PLAYS), "every camera")
        origin = f"http://127.0.0.1:{stored.server.port}/"
        assert any(url.startswith(origin) and "X-Amz-Signature=" in url for url in asked)
        page.page.keyboard.press("End")
        eventually(lambda: page.page.eval_on_selector_all("video[data-camera]", PLAYS), "the last picture")
        assert page.errors == []
    finally:
        page.close()
