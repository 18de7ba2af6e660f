"""A lab of several computers from the documents alone: built, blindly evaluated while one is cut off, and scanned."""

import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from django.urls import get_resolver, reverse

from tests.e2e.lab import CHROMIUM, NO_CHROMIUM, browsing
from tests.e2e.planned import handed, saved, shown, stopped
from tests.e2e.walk import NAMES, PLAN, ROBOTS, SETUP, Desk, Walk, documented
from tests.evaweb.crawling import named
from tests.namespaces import why_no_namespaces
from tests.processes import PATIENCE_MS, PATIENCE_S, eventually

pytestmark = pytest.mark.slow
CUT = ROBOTS[2]
TELLING = re.compile(rf"{'|'.join(NAMES)}|127\.0\.0\.1:900", re.IGNORECASE)
OPEN = {"/login/", "/healthz"}  # to somebody without a session, and what lies below /static/
SHUT = {401, 404, 405}


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """The lab as the administrator has built it, its plan frozen."""
    if why := why_no_namespaces():
        pytest.skip(why)
    if not (shutil.which("chromium") or Path(CHROMIUM).exists()):
        pytest.skip(NO_CHROMIUM)
    from playwright.sync_api import sync_playwright

    made = Walk(tmp_path_factory.mktemp("walk"))
    try:
        code = made.lab()
        with sync_playwright() as playwright, browsing(playwright, made.chromium) as browser:
            made.browser = browser
            built(browser, made, code)
            yield made
    finally:
        made.close()


def built(browser, walk, code):
    """What the document has the administrator do, page after page and computer after computer."""
    page = browser.new_page()
    page.set_default_timeout(PATIENCE_MS)

    def filled(path, button, **fields):
        page.goto(walk.url + path)
        for name, value in fields.items():
            page.fill(f"input[name={name}]", value)
        page.locator(button).first.click()
        page.wait_for_load_state()

    filled(
        "/first-account/", "button[type=submit]", code=code, username="alma", password=walk.passwords["alma"]
    )
    page.goto(f"{walk.url}/admin/auth/user/add/")
    page.check("input[name=role][value=operator]")
    for name, value in (
        ("username", "ann"),
        ("password1", walk.passwords["ann"]),
        ("password2", walk.passwords["ann"]),
    ):
        page.fill(f"input[name={name}]", value)
    page.click("input[name=_save]")
    page.get_by_text("was added successfully").wait_for()
    for name in ROBOTS:
        page.goto(f"{walk.url}/admin/stations/station/add/")
        page.fill("input[name=name]", name)
        page.select_option("select[name=robot]", "agilex_piper")
        page.check("input[name=simulated]")
        page.click("input[name=_continue]")
        page.get_by_role("link", name="Enrol a computer").click()
        page.get_by_role("button", name="Show a code").click()
        told = page.locator("#content").inner_text()
        asked = re.search(r"python -m runtime\.keys enrol (\S+) (\S+)", told)
        assert asked[1] == f"{walk.address}:8470"
        key = walk.run(name, documented(".venv/bin/python -m runtime.keys new")).rpartition(": ")[2].strip()
        enrol = documented(
            ".venv/bin/python -m runtime.keys enrol", **{"lab.example.org": walk.address}, CODE=asked[2]
        )
        said = walk.run(name, enrol)
        assert key in said
        assert re.search(r"This lab's key\s+([0-9a-f ]+):", told)[1] in said
        walk.station(name)
    page.context.close()
    walk.run(
        "lab", documented("python manage.py plans import", **{"lab.toml": "-", "NAME": "alma"}), said=SETUP
    )
    owner = Desk(browser, walk, "alma").open(f"/result/plans/{PLAN}/")
    owner.page.get_by_role("link", name="Continue this draft").click()
    owner.page.get_by_role("navigation", name="Steps").get_by_role("link", name="Freeze").click()
    owner.page.get_by_role("button", name="Freeze this plan").click()
    owner.page.get_by_role("button", name="Freeze “Three benches”").click()
    owner.page.locator(".chip", has_text="running").wait_for()
    owner.close()


@pytest.fixture
def benches(walk):
    """Two windows of one operator: at the station that will be cut off, and at the others, one after the other."""
    cut = Desk(walk.browser, walk, "ann")
    yield cut, cut.another()
    assert cut.complaints == []
    cut.close()


def at_work(operator, name):
    """The operator has taken this station, chosen the plan and confirmed the cameras."""
    operator.open(f"/stations/{name}/eval/")
    operator.at_rest()
    operator.take()
    operator.page.select_option("#plan-choice", PLAN)
    operator.page.locator("[data-confirm-cameras]").click()


def runs(operator):
    """The next trial is handed out and runs; its code."""
    code = handed(operator)
    operator.press("run")
    return code


def scored(operator, ticks):
    """The run is stopped, or has ended by itself, and is scored."""
    stop = operator.page.locator("[data-command=stop][data-trial]:visible")
    stop.or_(operator.page.locator("#score")).first.wait_for()
    operator.look()
    if stop.is_visible():
        stopped(operator)
    saved(operator, ticks)


def test_a_blind_evaluation_goes_on_while_a_station_is_cut_off_and_counts_each_trial_once(
    walk, benches, record_property
):
    cut, other = benches
    other.open("/")
    for name in ROBOTS:
        other.page.locator("main", has_text=name).wait_for()
    at_work(cut, CUT)
    codes = [runs(cut)]
    cut.reaches("RUNNING")
    pulled = time.monotonic()
    walk.network.pull(CUT)
    cut.reaches("NO STATION")  # `python -m benchmarks lab` holds it to 1.5 s
    record_property("shown_as_lost_s", time.monotonic() - pulled)
    cut.page.locator("#situation", has_text="the link to its computer is lost").wait_for()

    for name in ROBOTS[:2]:
        at_work(other, name)
        for ticks in ((1,), (1, 2)):
            codes.append(runs(other))
            scored(other, ticks)
    assert shown(cut) == codes[0]
    assert "NO STATION" in cut.state()
    found = {trial["code"]: trial["status"] for trial in other.api("trials")["items"]}
    assert found == {codes[0]: "running", **dict.fromkeys(codes[1:], "scored")}

    walk.network.plug(CUT)
    eventually(
        lambda: cut.state() in ("HOLDING", "READY"),
        "the station is back, without its operator",
        3 * PATIENCE_S,
    )
    cut.take_again()
    scored(cut, ticks=(1,))
    codes.append(runs(cut))
    scored(cut, ticks=(1, 2))
    cut.page.locator(".plan-progress", has_text="6 of 6").wait_for()
    trials = cut.api("trials")["items"]
    assert sorted(trial["code"] for trial in trials) == sorted(codes)
    assert {(trial["status"], trial["attempt"]) for trial in trials} == {("scored", 1)}
    cut.look()
    assert len(cut.seen) > 100  # of both windows
    assert [text for text in cut.seen if TELLING.search(text)] == []

    episodes = walk.data("lab") / "episodes"
    recorded = {trial["episode"] for trial in trials}
    assert len(recorded) == len(trials)
    eventually(
        lambda: recorded == {folder.name for folder in episodes.glob("*-*")},
        "the recordings have come",
        3 * PATIENCE_S,
    )
    found = revealed(walk)
    assert {name: arm["n"] for name, arm in found["arms"].items()} == dict.fromkeys(NAMES, len(ROBOTS))
    report = walk.folder / "report"
    walk.run("lab", f"python manage.py eval_report {PLAN} --out {report}")
    again = subprocess.run(
        [sys.executable, "-m", "recompute"],
        cwd=report,
        capture_output=True,
        text=True,
        timeout=3 * PATIENCE_S,
    )
    assert again.returncode == 0, again.stdout + again.stderr


def revealed(walk):
    """The owner closes the plan and reveals it; its results."""
    owner = Desk(walk.browser, walk, "alma").open(f"/result/plans/{PLAN}/")
    page = owner.page
    page.locator("summary", has_text="Close the plan").click()
    page.locator("input[name=reason]:visible").first.fill("it is finished")
    page.get_by_role("button", name="Close this plan").click()
    page.locator("summary", has_text="Reveal which").click()
    page.get_by_role("button", name="Reveal now").click()
    page.locator(".chip", has_text="revealed").wait_for()
    try:
        return owner.api(f"plans/{PLAN}/1/results")
    finally:
        owner.close()


def test_nothing_answers_but_login_health_and_enrolled_connections(walk):
    gate = [8470, 8471]
    assert walk.scan("ports", walk.address) == {"tcp": [8000, 8001, *gate], "refused": 65535 - 4, "udp": []}
    for name in ROBOTS:
        assert walk.scan("ports", walk.network.address[name]) == {"tcp": [], "refused": 0, "udp": []}
    walk.network.open(ROBOTS[0])  # nobody listens there, whatever a firewall does
    found = walk.scan("ports", walk.network.address[ROBOTS[0]])
    assert found == {"tcp": [], "refused": 65535, "udp": []}
    for port in gate:
        got = walk.scan("link", walk.address, str(port))
        assert got["messages"] == [0, 0]
        assert len(got["http"]) <= 2 * 64  # a greeting of ZMTP, which says that it wants CURVE
        assert bytes.fromhex(got["http"])[12:17] in (b"CURVE", b"")
    paths = [reverse(name) for name, parameters in named(get_resolver()) if not parameters]
    paths += [
        "/healthz",
        "/admin/",
        "/stations/bench-a/",
        "/stations/bench-a/eval/",
        "/api/v1/stations/bench-a",
    ]
    paths += ["/static/", "/static/../manage.py", "/data/eva.sqlite3", "/ws/stations/bench-a"]
    for port, public in ((8000, OPEN), (8001, set())):
        answered = walk.scan("web", f"{walk.address}:{port}", *paths)
        shut = {path for path, (status, to) in answered.items() if status in SHUT or to.endswith("/login/")}
        assert set(answered) - shut <= OPEN, {path: answered[path] for path in set(answered) - shut}
        assert public <= set(answered) - shut
