"""A person at the bench: what they press and what they see."""

import os

from tests.e2e.lab import STATION
from tests.e2e.pixels import pixels
from tests.processes import PATIENCE_MS, PATIENCE_S, eventually

LATE_MS = int(os.environ.get("EVA_TESTS_LATE_MS", "0"))
# What the live socket brings reaches the page so much later: a slow connection, or a machine that draws too much.
_LATE = f"""
const Own = window.WebSocket;
const given = (told, message) => (told.handleEvent ? told.handleEvent(message) : told(message));
const late = (told) => (message) => setTimeout(() => given(told, message), {LATE_MS});
window.WebSocket = class extends Own {{
  set onmessage(told) {{ super.onmessage = late(told); }}
  addEventListener(kind, told, ...more) {{
    super.addEventListener(kind, kind === "message" ? late(told) : told, ...more);
  }}
}};
"""


class BenchPage:
    """One browser window of one logged-in person; `errors` collects what its scripts complain of."""

    def __init__(self, browser, demo, username, size, **screen):
        self.demo = demo
        self.context = browser.new_context(
            viewport=size, ignore_https_errors=True, **{"color_scheme": "dark", **screen}
        )
        self.page = self.context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)  # of a busy machine, as in tests.processes
        self.errors: list[str] = []
        if LATE_MS:
            self.page.add_init_script(_LATE)
        self._listen()
        self.log_in(username)

    def _listen(self):
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", self._said)

    def _said(self, said):
        if said.type == "error":
            self.errors.append(said.text)

    def log_in(self, username):
        """Fill in the form, at first and where the session has ended."""
        self.page.goto(f"{self.demo.url}/login/")
        self.page.fill("input[name=username]", username)
        self.page.fill("input[name=password]", self.demo.passwords[username])
        self.page.click("button[type=submit]")
        self.page.wait_for_url(lambda url: "/login" not in url)

    def open(self, path):
        self.page.goto(f"{self.demo.url}{path}")
        return self

    def state(self):
        """The one word of the status bar."""
        return self.page.locator(".status-state .state").inner_text().strip().upper()

    def reaches(self, word):
        eventually(
            lambda: word in self.state(), f"the status bar says {word}, not {self.state()}", 3 * PATIENCE_S
        )

    def at_rest(self):
        """The page shows a station that can be set up."""
        eventually(
            lambda: self.state() in ("IDLE", "READY"), "the status bar says IDLE or READY", 3 * PATIENCE_S
        )

    def take(self):
        self.page.click("[data-lease=claim]")
        self.page.locator("[data-lease-when=mine]").wait_for()

    def take_again(self):
        """Have the station, whether its lease has ended meanwhile or is that of a page which was closed."""
        whose = [self.page.locator(f"[data-lease-when={lease}]") for lease in ("mine", "elsewhere", "free")]
        mine, elsewhere, _ = whose
        eventually(lambda: any(one.is_visible() for one in whose), "the page knows who has the station")
        if elsewhere.is_visible():
            self.page.click("[data-lease=move]")
            mine.wait_for()
        elif not mine.is_visible():
            self.take()

    def answered(self, command):
        """What was pressed has its answer: until then the same again would not be sent."""
        self.page.locator(f"[data-command={command}][data-pressed]").first.wait_for(state="detached")

    def press(self, command):
        self.answered(command)
        self.page.locator(f"[data-command={command}]:visible:enabled").first.click()

    def api(self, path):
        answer = self.page.request.get(f"{self.demo.url}/api/v1/{path}")
        assert answer.ok, answer.text()
        return answer.json()

    def snapshot(self):
        """The station's newest snapshot; there is none while it has not answered the web in time."""
        return eventually(lambda: self.api(f"stations/{STATION}")["snapshot"], "the station answers")

    def truth(self):
        """What the simulated bench says of itself."""
        return self.snapshot()["truth"]

    def cameras_live(self):
        """Every camera pane has a picture that is not stale."""
        panes = self.page.locator(".camera")
        live = self.page.locator(".camera:not([data-stale])")
        eventually(lambda: panes.count() == live.count() > 0, "all cameras show fresh pictures")
        return panes.count()

    def camera(self, key):
        return pixels(self.page.locator(f".camera[data-camera={key}] canvas"))

    def scene(self):
        self.page.locator("#scene-note").wait_for(state="hidden")  # it is drawn
        return pixels(self.page.locator("#scene"))

    def close(self):
        self.context.close()
