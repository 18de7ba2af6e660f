"""A person at the Debug tab: what they press with which keys, and what the page says of it."""

import pytest

from tests.e2e.bench_page import BenchPage
from tests.processes import PATIENCE_S, eventually

MODE_KEYS = {"sim": "1", "step": "2", "preview": "3", "continuous": "4", "manual": "5"}


class DebugPage(BenchPage):
    """Somebody at the Debug tab who uses keys wherever there are some."""

    def keys(self, *pressed):
        for key in pressed:
            self.page.keyboard.press(key)

    def says(self, part, words):
        """The part of the page says these words."""
        place = self.page.locator(part)
        eventually(lambda: words in place.inner_text(), f"{part} says {words!r}")

    def quiet(self, part):
        self.page.locator(part).wait_for(state="hidden")

    def set_up(self):
        if self.state() == "HOLDING":
            self.press("stop")
        self.at_rest()
        began = self.snapshot()["sequence"]
        self.press("setup")
        eventually(
            lambda: self.snapshot()["sequence"] > began + 1, "the set-up has begun and ended", 3 * PATIENCE_S
        )
        self.reaches("READY")
        self.at_the_pose()

    def at_the_pose(self):
        """The page has seen the robot where the set-up has brought it."""
        home = self.snapshot()["facts"]["home"]

        def there():
            shown = self.joints()
            return bool(shown) and shown == pytest.approx(home[: len(shown)], abs=0.02)

        eventually(there, f"the page shows the robot at {home}")

    def run_in(self, mode):
        """Choose the mode and begin."""
        self.reaches("READY")
        self.keys(MODE_KEYS[mode])
        self.press("run")
        self.reaches("RUNNING")
        begun = self.page.locator("[data-grip=open][aria-disabled=false]").first  # its recording is open
        begun.wait_for(state="attached")
        assert self.snapshot()["mode"] == mode

    def step_and_commit(self, before):
        """In preview: the robot moves by a chunk that was shown; asked for anew where this machine was late."""
        phases = {"a chunk is shown": "k", "waiting for you": "n"}

        def moved():
            phase = self.page.locator("[data-mode=phase]").inner_text()
            key = "o" if self.state() == "HOLDING" else phases.get(phase)
            if key and not self.moved_from(before):
                self.keys(key)
                self.page.wait_for_timeout(200)
            return self.moved_from(before)

        eventually(moved, "the committed chunk is executed", 3 * PATIENCE_S)

    def stop(self):
        self.press("stop")
        self.reaches("READY")

    def joints(self):
        """Where the joints of the first group are told to be, as the sliders show it while nobody moves them."""
        fields = self.page.locator("#joints input[type=number]")
        return fields.evaluate_all("all => all.map((field) => Number(field.value))")

    def moved_from(self, before, by=0.02):
        return max(abs(now - then) for now, then in zip(self.joints(), before, strict=True)) > by

    def stands(self):
        """Whether what the robot is told does not change; the phase may still be that of before a press."""
        before = self.joints()
        self.page.wait_for_timeout(400)
        return self.joints() == before

    def said(self):
        """What is said of the target."""
        return self.page.locator("[data-target=said]").inner_text()
