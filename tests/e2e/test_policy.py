"""Every page that can be reached by its links, in a real browser: nothing of it is against the policy that it is sent
with, and no script complains. The 3D scene is drawn, and a video that no cache may keep is played and sought in."""

from itertools import cycle
from urllib.parse import urlsplit

import pytest
from django.urls import Resolver404, resolve

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import STATION, WIDE
from tests.e2e.pixels import share, white
from tests.processes import PATIENCE_MS, eventually
from tests.runtime.datasets.foreign import Plan, write
from tests.runtime.quality import built

pytestmark = pytest.mark.slow
ROBOT = "agilex_piper"
SEEDS = (
    "/",
    f"/stations/{STATION}/eval/",
    "/result/",
    "/replay/",
    "/replay/datasets/",
    "/password/",
    "/admin/",
)
MORE = (
    f"/stations/{STATION}/collect/",
    "/result/wall/",
    "/result/planner/",
    "/result/rate/",
    "/result/prefer/",
    "/result/trials/1/",
)
SAME = ("history", "delete")  # of administration: one page for all models
OF_EACH = 2  # addresses of one view; of administration, whose pages are made by one machine, one and one that pops up
DRAWN = "() => new Promise((seen) => requestAnimationFrame(() => requestAnimationFrame(seen)))"
MADE = f"""
from django.contrib.auth.models import User
from evaweb.stations.models import Station
from evaweb.trials import services
from evaweb.trials.models import Checkpoint, Scene
from evaweb.episodes.reconcile import reconcile
reconcile()
scene, user = Scene.objects.earliest("pk"), User.objects.get(username="admin")
trial = services.prepare_trial(
    user=user, station=Station.objects.get(name="{STATION}"), scene=scene, position=scene.positions.first(),
    checkpoint=Checkpoint.objects.first(), seed=1,
)
services.abandon_trial(user=user, trial=trial)
"""
# Of these at least one page has to be found; whatever else there is is looked at as well.
WANTED = {
    *("home", "station-eval", "station-debug", "station-collect", "replay-list", "replay", "password"),
    *("dataset-list", "dataset", "dataset-replay", "side-by-side", "result", "result-trial", "result-plans"),
    *("result-plan", "lab-dashboard", "lab-wall", "result-planner", "rate", "prefer", "admin:index"),
    *("admin:auth_user_changelist", "admin:auth_user_add", "admin:auth_user_change"),
    *("admin:trials_scene_change", "admin:trials_checkpoint_change", "admin:stations_station_change"),
    *("admin:plans_plan_changelist", "admin:plans_plan_import", "result-plan-new"),
    *("setup", "setup-scenes", "setup-scene", "setup-new-scene", "setup-sheet"),
}


@pytest.fixture(scope="module")
def filled(patient):
    """The lab with an episode, a trial, and a dataset of somebody else."""
    uuid = built.record_of(patient.data / "episodes", ROBOT, started_wall=1.7e9, station=STATION).name
    write(patient.data / "datasets" / "policy", Plan("v3.0", lengths=(40, 50), fps=10.0, gop=10))
    patient.python(MADE)
    return patient, uuid


class Watched(BenchPage):
    """Says of each violation where it was."""

    def __init__(self, *who):
        super().__init__(*who)
        self.under_way = set()
        self.page.on("request", self._asks)
        for end in ("requestfinished", "requestfailed"):
            self.page.on(end, lambda request: self.under_way.discard(request))

    def _asks(self, request):
        if request.is_navigation_request():
            self.under_way.clear()  # whatever the page before it asked for
        if request.resource_type != "media":  # a video is read as far as it is needed
            self.under_way.add(request)

    def open(self, path):
        super().open(path)
        note = self.page.locator("#scene-note")
        if note.count():
            told = lambda: note.is_hidden() or not note.inner_text().startswith("Loading")  # noqa: E731
            eventually(told, f"{path} has drawn its scene, or said why not")

        def settled():
            self.page.evaluate(DRAWN)
            return not self.under_way

        eventually(settled, f"{path} has all that it asks for, and is drawn: {self.under_way}")
        return self

    def links(self):
        """The addresses on the page that are pages of this lab.

        Those of administration are the same pages filtered, sorted, and on the way back there, unless they pop up.
        """
        for address in self.page.locator("a[href]").evaluate_all(
            "(all) => all.map((one) => new URL(one.getAttribute('href'), document.baseURI).href)"
        ):
            if not address.startswith(self.demo.url + "/") or "#" in address:
                continue
            path = urlsplit(address).path
            try:
                found = resolve(path)
            except Resolver404:
                continue
            same = found.app_name == "admin" and "_popup" not in address
            yield path if same else address.removeprefix(self.demo.url)

    def shows(self, path):
        """Whether it answers with a page, and not with a file to keep."""
        answer = self.page.request.get(self.demo.url + path, timeout=PATIENCE_MS)
        kind, name = answer.headers["content-type"], answer.headers.get("content-disposition", "")
        assert "default-src 'self'" in answer.headers["content-security-policy"], path
        return kind.startswith("text/html") and "attachment" not in name

    def complaints(self):
        """What its scripts have complained of on the page that it shows, told once."""
        told, self.errors[:] = list(self.errors), []
        return told


def crawled(windows, seeds):
    """Visit all that can be reached, some of each view; the errors by address, and the names of the views.

    By turns in several windows: each page stays open while the next one loads, and what it does late is seen.
    """
    waiting, asked, seen, errors, shown, names = list(seeds), set(), {}, {}, {}, set()

    def left(window):
        if complaints := window.complaints():
            errors[shown.get(window, "login")] = complaints

    turns = cycle(windows)
    while waiting:
        path = waiting.pop(0)
        name = resolve(urlsplit(path).path).view_name
        of_each, kind = OF_EACH, (name, False)
        if name.startswith("admin:"):
            action = name.rpartition("_")[2]
            of_each, kind = 1, (action if action in SAME else name, "_popup" in path)
        if path in asked or len(seen.get(kind, [])) >= of_each:
            continue
        window = next(turns)
        asked.add(path)
        if not window.shows(path):
            continue
        seen.setdefault(kind, []).append(path)
        names.add(name)
        left(window)
        shown[window] = path
        window.open(path)
        waiting += window.links()
    for window in windows:
        left(window)
    return errors, names


def test_no_page_does_what_its_policy_forbids(browser, filled):
    demo, uuid = filled
    windows = [Watched(browser, demo, "admin", WIDE) for _ in range(2)]
    errors, seen = crawled(windows, [*SEEDS, *MORE, f"/replay/{uuid}/"])
    assert errors == {}
    assert sorted(WANTED - seen) == []
    for window in windows:
        window.close()


def test_the_scene_is_drawn_under_it(browser, filled):
    page = Watched(browser, filled[0], "ann", WIDE).open(f"/stations/{STATION}/debug/")
    assert share(page.scene(), white) > 0.005
    assert page.errors == []
    page.close()


def test_what_is_not_logged_in_and_what_is_not_there_too(browser, filled):
    demo, _ = filled
    page = Watched(browser, demo, "visitor", WIDE)
    for path, status in (("/nowhere", 404), ("/admin/auth/user/", 302), ("/replay/?quality=no", 200)):
        page.open(path)
        assert all(f"status of {status}" in error for error in page.errors), (path, page.errors)
        page.errors.clear()
    page.context.clear_cookies()
    page.open("/login/")
    assert page.errors == []
    page.close()


def test_no_cache_keeps_a_video_and_it_is_sought_in_all_the_same(browser, filled):
    demo, _ = filled
    page = Watched(browser, demo, "ann", WIDE).open("/replay/datasets/policy/-/0/")
    video = page.page.locator("video[data-camera]").first
    address = video.evaluate("(one) => one.currentSrc")
    answer = page.page.request.get(address, headers={"Range": "bytes=0-99"})
    assert (answer.status, answer.headers["cache-control"]) == (206, "no-store")
    page.page.keyboard.press("End")
    eventually(
        lambda: video.evaluate("(one) => !one.seeking && one.readyState >= 2 && one.currentTime > 3"),
        "its end is shown",
    )
    assert page.errors == []
    page.close()


def test_a_page_that_was_left_is_fetched_anew_and_kept_in_no_storage(browser, filled):
    demo, _ = filled
    page = Watched(browser, demo, "ann", WIDE).open("/result/")
    choice = page.page.locator("form.filter select").first
    choice.select_option(index=1)
    page.page.wait_for_url(lambda url: "?" in url)
    page.open("/replay/")
    page.page.go_back()
    page.page.locator("form.filter").wait_for()
    with page.page.expect_event("load"):  # the address changes at once; the page is then loaded anew
        page.page.go_back()
    assert not urlsplit(page.page.url).query
    assert page.page.locator(".brand").count() == 1
    kept = page.page.evaluate("Object.keys(sessionStorage).concat(Object.keys(localStorage))")
    assert "htmx-history-cache" not in kept
    assert page.errors == []
    page.close()
