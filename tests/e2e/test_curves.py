"""The live displays in a real browser: chunks among the curves, figures, and the robots that are not the real one."""

import numpy as np
import pytest

from tests.e2e.bench_page import BenchPage
from tests.e2e.lab import STATION, WIDE
from tests.e2e.pixels import pixels, share
from tests.e2e.remote import SKILLED, reset_station, visitor
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
TAGS = 40  # rows of pixels at the top of the plot, where sentences may stand that count seconds


class Live(BenchPage):
    """The Debug page, with what its displays say."""

    def read(self, mark):
        """The word beside a mark in the legend of the curves."""
        return self.page.locator(f"[data-mark={mark}] .legend-value").inner_text()

    @property
    def chunk(self):
        """The chunk that the legend names, -1 where it names none."""
        word = self.read("chunk")
        return int(word) if word.isdigit() else -1

    def tag(self, name):
        """The sentence in the corner of a pane about what is drawn there, "" where there is none."""
        return " ".join(self.page.locator(f"[data-tag={name}]").all_inner_texts())

    def sets_up(self):
        """Set up with the checkpoint that is chosen; again where this machine was late."""
        for _ in range(3):
            self.press("setup")
            self.reaches("SETTING UP")
            eventually(lambda: "SETTING UP" not in self.state(), "the set-up ends", 3 * PATIENCE_S)
            if "READY" in self.state():
                return
        raise AssertionError(f"it is not set up: {self.page.locator('[data-show=stage]').inner_text()}")

    def runs(self, mode):
        """Run in a mode."""
        self.page.locator(f"input[name=mode][value={mode}]").locator("..").click()
        self.press("run")
        eventually(self.moves, f"it runs in mode {mode}", 3 * PATIENCE_S)

    def moves(self):
        """Whether it runs; resumed where this machine was late."""
        if "HOLDING" in self.state() and self.page.locator("[data-command=resume]:visible:enabled").count():
            self.press("resume")
            eventually(lambda: "HOLDING" not in self.state(), "it goes on")
        return "RUNNING" in self.state()

    def control(self):
        """What control last did."""
        return self.snapshot()["control"]

    def stops(self):
        self.press("stop")
        self.reaches("READY")

    def blue(self):
        """The share of the scene that is as blue as only a ghost is."""
        return share(
            self.scene(), lambda red, green, blue: (blue > 0.35) & (blue > 1.6 * red) & (green > red)
        )


def columns(plot, inside):
    """How many columns of a picture are nearly all of a colour."""
    red, green, blue = np.moveaxis(plot.astype(int), -1, 0)
    return int((inside(red, green, blue).mean(axis=0) > 0.7).sum())


def band(red, green, blue):
    """Where chunks overlap: the panel, tinted violet."""
    return (blue - green > 13) & (red - green >= 0) & (blue < 110)


def hairline(red, green, blue):
    """Where another chunk takes over: a grey clearly lighter than panel and grid."""
    return (green > 75) & (abs(red - blue) < 60) & (blue >= red)


@pytest.fixture(scope="module")
def bench(browser, patient):
    live = Live(browser, patient, "operator", WIDE).open(f"/stations/{STATION}/debug/")
    live.at_rest()
    live.take()
    live.page.keyboard.press("6")
    live.page.select_option("#checkpoint", label=SKILLED)
    live.page.fill("#seed", "1")
    live.sets_up()
    yield live
    if live.state() not in ("READY", "IDLE"):
        live.press("stop")
    assert live.errors == []
    live.close()
    reset_station(visitor(patient, "admin"))


def test_a_proposed_chunk_is_a_ghost_until_it_is_cancelled(bench):
    before = bench.blue()
    bench.runs("preview")
    bench.press("step")
    eventually(lambda: "proposed" in bench.tag("chunk"), "the scene names the proposed chunk")
    eventually(lambda: bench.blue() > before + 0.002, "the ghost leaves the robot")
    bench.press("cancel")
    eventually(lambda: not bench.tag("chunk"), "nothing is proposed any more")
    bench.stops()


def test_in_simulation_the_scene_and_the_curves_say_which_robot_is_which(bench):
    bench.runs("sim")
    eventually(lambda: "simulated robot" in bench.tag("simulated"), "the simulated robot is named")
    eventually(lambda: "executed by the simulated robot" in bench.tag("simulated"), "so are its curves")
    eventually(lambda: bench.blue() > 0.005, "the simulated robot is drawn where it goes")
    bench.stops()


def test_a_target_is_a_ghost_and_moves_nothing(bench):
    said = bench.control()["behaviour"]
    before = bench.blue()
    bench.page.keyboard.press("7")
    bench.page.select_option("#pose", "home")
    eventually(lambda: "target" in bench.tag("aim"), "the scene names the target")
    assert bench.blue() > before + 0.005
    assert (bench.state(), bench.control()["behaviour"]) == ("READY", said)


def test_chunks_are_seen_in_the_curves_which_stand_still_while_the_data_goes_on(bench):
    bench.page.keyboard.press("6")
    bench.page.get_by_label("Ask at").fill("3")
    bench.press("tune")
    bench.runs("continuous")
    plot = bench.page.locator("#curves .u-over")
    eventually(
        lambda: bench.moves() and columns(pixels(plot), band) > 10,
        "bands stand where chunks overlap",
        3 * PATIENCE_S,
    )
    eventually(
        lambda: bench.moves() and columns(pixels(plot), hairline) >= 5,
        "hairlines stand between chunks",
        3 * PATIENCE_S,
    )
    bench.page.click("#curves-pause")
    eventually(lambda: "paused" in bench.tag("paused"), "the page says that the curves are paused")
    stood, chunk = pixels(plot), bench.chunk
    assert columns(stood, band) >= 3
    assert columns(stood, hairline) >= 3
    ticks = bench.control()["ticks"]
    eventually(lambda: bench.control()["ticks"] > ticks + 45, "the run goes on")
    assert np.array_equal(pixels(plot)[TAGS:], stood[TAGS:])
    assert bench.chunk == chunk
    bench.page.click("#curves-pause")
    eventually(lambda: bench.moves() and bench.chunk > chunk, "the curves go on")


def test_the_cursor_names_the_chunk_that_led_then(bench):
    box = bench.page.locator("#curves .u-over").bounding_box()
    newest = eventually(lambda: bench.moves() and max(0, bench.chunk), "the newest chunk is named")
    bench.page.click("#curves-pause")

    def older():
        """Whether the cursor, going back in time, comes upon a chunk from before."""
        for back in range(20, int(box["width"]), 20):
            bench.page.mouse.move(box["x"] + box["width"] - back, box["y"] + 60)
            if 0 < bench.chunk < newest:
                return True
        return False

    eventually(older, "an older chunk is named")
    bench.page.mouse.move(5, 5)
    bench.page.click("#curves-pause")


def test_latencies_and_delays_are_distributions_with_their_number(bench):
    bench.page.keyboard.press("9")
    for figure in ("latency", "delay"):
        shown = bench.page.locator(f"#figures [data-figure={figure}]")
        eventually(lambda shown=shown: "(n = " in shown.inner_text(), f"{figure} is measured")
        assert shown.locator("rect.bar").count() >= 1
        assert shown.locator("line").count() == 2
    assert "p99.9" in bench.page.locator("#figures").inner_text()
    bench.stops()
