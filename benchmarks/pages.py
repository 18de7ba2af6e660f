"""Pages of a lab with 100,000 trials in Debian's Chromium, one at a time, while the station is idle.

Each page is loaded five times by a new browser. LCP, CLS and event durations are from Chromium's PerformanceObserver,
including events that lead to another document. Pages with 3D drawing use software rendering here, and have their own
requirements.
"""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.labs import ROOT, STATION, RunningLab, lab
from benchmarks.report import Figure, Report
from evaweb.lab.single_trial import TrialChoice, run_one_trial

PLANS, TRIALS = 200, 100_000
LOADS = 5
_AXE = ROOT / "node_modules" / "axe-core" / "axe.min.js"
_LATER_MS = 1000  # wait after loading for late content
_VIEWPORT: Any = {"width": 1440, "height": 900}
_SEEKS = (0.3, 0.7, 0.1, 0.9, 0.5)  # positions in an episode
# Runs before a page's own scripts. An event that leads away is recorded at the page's end, and read on the next page.
_WATCH = """
window.seen = { fcp: 0, lcp: 0, cls: 0, inp: Number(sessionStorage.getItem("inp")) };
const watch = (type, each, more = {}) => {
  const observer = new PerformanceObserver((list) => list.getEntries().forEach(each));
  observer.observe({ type, buffered: true, ...more });
  return observer;
};
watch("paint", ({ name, startTime }) => name === "first-contentful-paint" && (seen.fcp = startTime));
watch("largest-contentful-paint", ({ startTime }) => (seen.lcp = startTime));
watch("layout-shift", ({ value, hadRecentInput }) => hadRecentInput || (seen.cls += value));
const interacted = ({ interactionId, duration }) => interactionId && (seen.inp = Math.max(seen.inp, duration));
const presses = watch("event", interacted, { durationThreshold: 16 });
watch("first-input", interacted); // whatever it takes
window.addEventListener("pagehide", () => {
  presses.takeRecords().forEach(interacted);
  sessionStorage.setItem("inp", seen.inp);
});
"""
_KB = """() => [...performance.getEntriesByType("navigation"), ...performance.getEntriesByType("resource")]
  .filter(({ initiatorType, name }) => !["video", "img"].includes(initiatorType)
    && !/\\.(stl|dae|obj|jpe?g|png)\\b/i.test(name))
  .reduce((sum, { transferSize }) => sum + transferSize, 0) / 1000"""
_FOUND = """async (theme) => {
  document.documentElement.dataset.theme = theme;
  await new Promise((done) => requestAnimationFrame(() => setTimeout(done, 300))); // colours that fade are there
  const { violations } = await axe.run(document, { resultTypes: ["violations"] });
  return violations.map(({ id }) => `${theme}: ${id}`);
}"""
_PLAYABLE = """() => {
  const videos = [...document.querySelectorAll("video[data-camera]")];
  return videos.length > 0 && videos.every(({ readyState, seeking }) => readyState >= 2 && !seeking);
}"""
_PAINTED = (
    "new Promise((done) => requestAnimationFrame(() => setTimeout(done, 100)))"  # events come after a frame
)
# From the event to the image: every camera shows the requested row. Chromium does not report each displayed frame, so
# a video that was sought and painted counts too.
_SEEK = """async (share) => {
  const range = document.querySelector("#scrub"), videos = [...document.querySelectorAll("video[data-camera]")];
  const shown = (video) => new Promise((done, late) => {
    video.requestVideoFrameCallback(done);
    const painted = () => requestAnimationFrame(() => requestAnimationFrame(done));
    video.addEventListener("seeked", painted, { once: true });
    setTimeout(() => late(new Error(`${video.dataset.camera} shows no picture within 20 s`)), 20_000);
  });
  const all = Promise.all(videos.map(shown)), from = performance.now();
  range.value = String(Math.round(share * Number(range.max)));
  range.dispatchEvent(new Event("input", { bubbles: true }));
  await all;
  return performance.now() - from;
}"""


Control = Callable[[Any], None]
"""Action of a user on a Playwright page."""


@dataclass(frozen=True, slots=True)
class Page:
    """Page to measure: its address, its most common controls, and those that lead to another document.

    `draws` is True if the page draws in 3D.
    """

    name: str
    address: str
    controls: Sequence[Control]
    onward: Sequence[str] = ()
    draws: bool = False


def click(selector: str) -> Control:
    """Return a function that clicks the first element that matches `selector`."""
    return lambda page: page.locator(selector).first.click()


def press(selector: str, key: str) -> Control:
    """Return a function that presses `key` with the focus on the first element that matches `selector`."""
    return lambda page: page.locator(selector).first.press(key)


def drag(selector: str) -> Control:
    """Return a function that drags the first element that matches `selector` a short way sideways."""

    def dragged(page: Any) -> None:
        page.locator(selector).first.hover()
        page.mouse.down()
        box = page.locator(selector).first.bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2 + 20, box["y"] + box["height"] / 2, steps=5)
        page.mouse.up()

    return dragged


def narrow(name: str, words: str = "") -> Control:
    """Return a function that filters a list by its field `name`, and waits until the list shows the filter.

    The function types `words` into the field. If `words` is "", the function selects the next choice of the field.
    """

    def narrowed(page: Any) -> None:
        with page.expect_response(lambda answer: f"{name}=" in answer.url):
            field = page.locator(f"[data-list-filter] [name={name}]")
            if words:
                field.press_sequentially(words)
            else:
                field.press("ArrowDown")
        page.locator(".filter-chip").first.wait_for()

    return narrowed


def pages(episode: str, trial: int) -> Sequence[Page]:
    """Return the measured pages."""
    menu = click(".bar-user summary")
    find = (click("[data-open-find]"), press("#find-words", "b"), press("#find-words", "Escape"))
    curves, above = click("#joint-next"), click("[data-view=top]")
    sort, unchip = "#list thead a", ".filter-chip a"
    figure = click(".figure-keep button")
    plan = "/result/plans/evaluation-001/1/"
    bench = f"/stations/{STATION}/"
    return (
        Page("home", "/", (*find, menu)),
        Page("eval", f"{bench}eval/", (curves, above, menu), draws=True),
        Page("debug", f"{bench}debug/", (curves, above, menu), draws=True),
        Page("replay", f"/replay/{episode}/", (click("#forth"), click("#back"), menu), draws=True),
        Page("episodes", "/replay/", (click("[data-tick]"), narrow("words", "block")), (sort, unchip)),
        Page(
            "datasets",
            "/replay/datasets/",
            (click("[name=datasets]"), click(".dataset-order > summary")),
            (sort,),
        ),
        Page("evaluations", "/result/plans/", (narrow("words", "evaluation"),), (sort, unchip)),
        Page("result", plan, (figure, click(".plan-record details > summary"), *find)),
        Page("comparison", f"{plan}compare/", (figure, *find), ("a[href*='differs=1']",)),
        Page("trials", "/result/", (narrow("scene"),), (sort, unchip)),
        Page(
            "trial",
            f"/result/trials/{trial}/",
            (click("[data-player-play]"), click("[data-seek]"), press("[data-player-slider]", "ArrowRight")),
        ),
        Page(
            "failures",
            "/result/failures/",
            (click("[data-trial] [data-why]"), press("[data-trial]", "ArrowRight"), click("#clips-play")),
        ),
        Page("setup", "/setup/", (*find, menu)),
        Page(
            "scene",
            "/setup/scenes/block-on-plate/",
            (click("#thumbnails button"), drag("#stage [data-thing]"), press("#label", "a")),
        ),
        Page("history", "/history/", (*find, menu)),
        Page("planner", "/result/planner/", (press("[name=hours]", "ArrowUp"), *find)),
        Page("cite", f"{plan}cite/", (click("details summary"), *find)),
        Page("integrity", f"{plan}integrity/", (*find, menu)),
        Page("wall", "/result/wall/", (press("body", "Tab"),)),
        Page("jobs", "/jobs/?status=done", find, (sort, unchip)),
        Page("dashboard", "/result/lab/", (*find, menu)),
    )


def measure(seconds: float, plans: int = PLANS, trials: int = TRIALS) -> Report:
    """Measure `fcp_ms.PAGE` and others.

    `seconds` is ignored, because the number of loads is fixed.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _seed(folder / "data", plans, trials)
        ready = folder / "ready.json"
        with lab(["manage.py", "demo", "--port", "0", "--ready-file", str(ready)], ready) as demo:
            played = run_one_trial(
                demo.visitor, TrialChoice(STATION, "block-on-plate", 1, "pick-place-40k", 1)
            )
            rows, sought = _visits(demo, pages(played.episode, played.trial))
    return Report("pages", [*figures(rows), Figure("seek_ms", sought, "ms", "<= 150")], rows)


def figures(rows: Sequence[Mapping[str, Any]]) -> Iterator[Figure]:
    """Yield the figures of each page."""
    for name in dict.fromkeys(row["page"] for row in rows):
        own = [row for row in rows if row["page"] == name]
        kind, lcp, inp = ("_3d", 2500, 200) if own[0]["draws"] else ("", 1000, 100)
        yield Figure(f"fcp_ms.{name}", _median(own, "fcp"), "ms")
        yield Figure(f"lcp{kind}_ms.{name}", _median(own, "lcp"), "ms", f"<= {lcp}")
        yield Figure(f"inp{kind}_ms.{name}", _median(own, "inp"), "ms", f"<= {inp}")
        yield Figure(f"cls.{name}", _median(own, "cls"), "", "<= 0.02")
        yield Figure(f"kb.{name}", _median(own, "kb"), "kB", "<= 400")
    yield Figure("axe_violations", sum(len(row["axe"]) for row in rows), "", "== 0")


def _seed(data: Path, plans: int, trials: int) -> None:
    """Create a database as after years of use, in a separate program with Django set up for the data folder."""
    data.mkdir()
    program = (
        "import django; django.setup()\n"
        "from django.core.management import call_command; call_command('migrate', verbosity=0)\n"
        f"from benchmarks.results_seed import seed; seed({plans}, {trials})\n"
        "from django.db import connection; connection.cursor().execute('ANALYZE')"
    )
    variables = os.environ | {
        "EVA_DATA_DIR": str(data),
        "EVA_LOG_LEVEL": "ERROR",
        "DJANGO_SETTINGS_MODULE": "evaweb.settings",
    }
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=variables, check=True)


def _visits(demo: RunningLab, listed: Sequence[Page]) -> tuple[list[dict[str, Any]], float]:
    """Return a row per load of the pages `listed`, and the median duration of a seek in the episode [ms]."""
    from playwright.sync_api import sync_playwright

    url = demo.announced["url"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium") or "/usr/bin/chromium",
            args=["--no-sandbox", "--enable-unsafe-swiftshader"],
        )
        session = _login(browser, url, demo.announced["passwords"]["admin"])

        def fresh() -> Any:
            return browser.new_context(storage_state=session, viewport=_VIEWPORT).new_page()

        rows = [row for listed_page in listed for row in _loads(fresh, url, listed_page)]
        replay = next(listed_page for listed_page in listed if listed_page.name == "replay")
        page = fresh()
        page.goto(url + replay.address)
        page.wait_for_function(_PLAYABLE)
        sought = statistics.median(page.evaluate(_SEEK, share) for share in _SEEKS)
        browser.close()
    return rows, sought


def _login(browser: Any, url: str, password: str) -> Any:
    page = browser.new_page()
    page.goto(f"{url}/login/")
    page.fill("input[name=username]", "admin")
    page.fill("input[name=password]", password)
    page.click("button[type=submit]")
    page.wait_for_url(lambda address: "/login" not in address)
    return page.context.storage_state()


def _loads(fresh: Callable[[], Any], url: str, target: Page) -> Iterator[dict[str, Any]]:
    """Yield a row for each of five loads of a page after a warm-up; the last load is checked by axe-core in both
    themes.
    """
    for load in range(LOADS + 1):
        page = fresh()
        page.add_init_script(_WATCH)
        page.goto(url + target.address, wait_until="load")
        page.wait_for_timeout(_LATER_MS)
        kb = page.evaluate(_KB)
        for control in target.controls:
            control(page)
            page.evaluate(_PAINTED)
        row = page.evaluate("seen") | {"page": target.name, "draws": target.draws, "kb": kb, "axe": []}
        if load == LOADS:
            page.evaluate(_AXE.read_text("utf-8"))
            row["axe"] = [fault for theme in ("dark", "light") for fault in page.evaluate(_FOUND, theme)]
        for selector in target.onward:
            with page.expect_event("load"):
                page.locator(selector).first.click()
            row["inp"] = page.evaluate("seen.inp")  # includes events of the previous page
        page.context.close()
        if load:
            yield row


def _median(rows: Sequence[Mapping[str, Any]], name: str) -> float:
    return statistics.median(float(row[name]) for row in rows)
