"""Time until an episode plays: from opening its address to the first image of every camera.

The demo records a run; then the web alone serves it to Debian's Chromium with an empty cache.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.labs import ROOT, STATION, lab
from benchmarks.report import Figure, Report
from evaweb.lab.rest_client import LivePage, RestClient
from evaweb.lab.single_trial import TrialChoice, start

SECONDS = 30.0  # of the recording
_AGAIN = 9
_KNOWN_S = 60.0
_SHOWN_MS = 30_000
# Runs before the page's own scripts: records when every camera has an image, in ms since the navigation.
_WATCH = """
(() => {
  const cameras = () => [...document.querySelectorAll("video[data-camera]")];
  const look = () => {
    const all = cameras();
    if (all.length && all.every((video) => video.readyState >= 2 && !video.seeking)) window.shownAt = performance.now();
    else requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
  window.fetched = () => performance.getEntriesByType("resource")
    .filter((one) => one.initiatorType === "video").reduce((sum, one) => sum + one.transferSize, 0);
})();
"""


def measure(seconds: float) -> Report:
    """Measure `replay_start_ms`, and `replay_fetched_share` (of the videos' bytes): medians of nine visits by new
    browsers.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ready = folder / "ready.json"
        with lab(["manage.py", "demo", "--port", "0", "--ready-file", str(ready)], ready) as demo:
            episode = _recorded(demo.visitor, seconds)
            password = demo.announced["passwords"]["operator"]
        size = sum(video.stat().st_size for video in (folder / "data" / "previews" / episode).glob("*.mp4"))
        with _web(folder / "data") as url:
            rows = list(_visits(url, password, episode, size))
    figures = [
        Figure("replay_start_ms", _median(rows, "start_ms"), "ms", "<= 500"),
        Figure("replay_start_worst_ms", max(row["start_ms"] for row in rows), "ms"),
        Figure("replay_fetched_share", _median(rows, "fetched_share"), ""),
        Figure("replay_videos_mb", size / 1e6, "MB"),
    ]
    return Report("replay", figures, rows)


def _recorded(visitor: RestClient, seconds: float) -> str:
    """Return the episode of a run of `seconds`, as soon as its videos can be played."""
    with closing(LivePage(visitor, STATION)) as page:
        scene = visitor.get("scenes")["items"][0]
        checkpoint = visitor.get("checkpoints")["items"][0]["name"]
        trial = start(
            visitor, page, TrialChoice(STATION, scene["name"], scene["positions"][0]["number"], checkpoint, 1)
        )
        time.sleep(seconds)
        page.command("stop", trial)
    deadline = time.monotonic() + _KNOWN_S
    while time.monotonic() < deadline:
        episode = visitor.get(f"trials/{trial}")["episode"]
        if episode and visitor.get(f"episodes/{episode}")["previewed_at"]:
            return str(episode)
        time.sleep(0.2)
    raise SystemExit(f"trial {trial} has no episode that can be played after {_KNOWN_S:g} s")


@contextmanager
def _web(data: Path) -> Iterator[str]:
    """Yield the address of a web process on a free port, without the other processes of a lab."""
    child = subprocess.Popen(
        [sys.executable, "manage.py", "serve", "--port", "0", "--lifeline"],
        cwd=ROOT,
        env=os.environ | {"EVA_DATA_DIR": str(data), "EVA_LOG_LEVEL": "WARNING"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        yield json.loads(child.stdout.readline())["url"]
    finally:
        child.stdin.close()
        child.wait(30.0)


def _visits(url: str, password: str, episode: str, size: int) -> Iterator[dict[str, Any]]:
    """Yield the results of visits by new browsers; the first visit, which warms up the web, is not among them."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        for visit in range(_AGAIN + 1):
            browser = playwright.chromium.launch(
                executable_path=shutil.which("chromium") or "/usr/bin/chromium",
                args=["--no-sandbox", "--enable-unsafe-swiftshader"],
            )
            page = browser.new_page(viewport={"width": 1440, "height": 900})
            page.goto(f"{url}/login/")
            page.fill("input[name=username]", "operator")
            page.fill("input[name=password]", password)
            page.click("button[type=submit]")
            page.wait_for_url(lambda address: "/login" not in address)
            page.add_init_script(_WATCH)
            page.goto(f"{url}/replay/{episode}/", wait_until="commit")
            page.wait_for_function("() => window.shownAt !== undefined", timeout=_SHOWN_MS)
            shown_at, fetched = page.evaluate("[window.shownAt, window.fetched()]")
            browser.close()
            if visit:
                yield {"start_ms": shown_at, "fetched_share": fetched / size}


def _median(rows: list[dict[str, Any]], name: str) -> float:
    return float(statistics.median(row[name] for row in rows))
