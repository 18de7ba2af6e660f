"""Time from a picture at the robot's node until it is on the screen of an open page ("glass to glass").

The node draws test patterns that contain their own number, and stamps each before it draws it. The page is the Debug
page in Debian's Chromium, with cameras and curves. A browser without a graphics card has no 3D, unless it is told to
let the processor draw it (`glass_3d_ms`). A picture counts as displayed at the first animation frame after the one in
which it was drawn, which is up to 17 ms after it was visible. The number is read from the drawn pixels, so nothing
rests on what the station or the page reports.
"""

from __future__ import annotations

import shutil
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from benchmarks.labs import STATION, ProcessorUsage, RunningLab, busy_lab, set_up
from benchmarks.report import Figure, Report
from evaweb.lab.rest_client import LivePage
from runtime.core import msgpack_arrays
from runtime.simulation.bench.numbered_frames import BITS

CAMERA = "cam_high"
_BROWSERS = {"glass_ms": ["--disable-3d-apis"], "glass_3d_ms": ["--enable-unsafe-swiftshader"]}
_MARGIN_S = 4.0
_SHOWN_S = 60.0
# Runs before the page's own scripts. After each drawing into the camera's canvas it reads the number from the top
# strip, and records the time of the next animation frame on the wall clock [ms].
_WATCH = """
([camera, bits]) => {
  window.shown = [];
  const draw = CanvasRenderingContext2D.prototype.drawImage;
  CanvasRenderingContext2D.prototype.drawImage = function (...given) {
    draw.apply(this, given);
    const { canvas } = this;
    if (canvas.closest(`[data-camera="${camera}"]`) === null) return;
    const { data } = this.getImageData(0, Math.floor(canvas.height / 60), canvas.width, 1);
    let number = 0;
    for (let bit = 0; bit < bits; bit += 1) {
      const at = 4 * Math.floor(((bit + 0.5) * canvas.width) / bits);
      if (data[at] + data[at + 1] + data[at + 2] > 3 * 127) number += 2 ** bit;
    }
    requestAnimationFrame(() => window.shown.push([number, performance.timeOrigin + performance.now()]));
  };
}
"""


class NodeListener(threading.Thread):
    """Thread that receives the node's observations; `stamps` maps the numbers of pictures to their stamps [s]."""

    def __init__(self, endpoint: str) -> None:
        super().__init__(daemon=True)
        self.stamps: dict[int, float] = {}
        self._endpoint, self._over = endpoint, threading.Event()

    def run(self) -> None:
        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            socket.setsockopt(zmq.SUBSCRIBE, b"")
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(self._endpoint)
            while not self._over.is_set():
                if socket.poll(100):
                    message = msgpack_arrays.unpack(socket.recv())
                    self.stamps[int(message["seq"])] = float(message["t"])

    def end(self) -> None:
        self._over.set()
        self.join()


def measure(seconds: float) -> Report:
    """Measure `glass_ms` from the node's stamp to the page without 3D, and `glass_3d_ms` with it."""
    with tempfile.TemporaryDirectory() as folder:
        settings = ["control.rate=30.0", "recording.fps=30.0"]
        with (
            busy_lab(Path(folder), settings, numbered=True) as lab,
            closing(LivePage(lab.visitor, STATION)) as page,
        ):
            set_up(page)
            page.command("run")
            page.wait(lambda state: state["state_is"]["going"], 10.0, "starting the run")
            listener = NodeListener(lab.announced["node"])
            listener.start()
            try:
                displayed = {name: _displayed(lab, seconds, draws) for name, draws in _BROWSERS.items()}
            finally:
                listener.end()
    figures = []
    for name, (shown, percent) in displayed.items():
        ages = _ages_ms(listener.stamps, shown)
        wanted = "<= 80" if name == "glass_ms" else ""
        figures += [
            Figure(f"{name}.p50", float(np.percentile(ages, 50)), "ms", wanted),
            Figure(f"{name}.p99", float(np.percentile(ages, 99)), "ms"),
            Figure(f"displayed_hz.{name}", len(ages) / seconds, "Hz"),
            Figure(f"lab_cpu_percent.{name}", percent["lab"], "%"),
            Figure(f"other_cpu_percent.{name}", percent["others"], "%"),
        ]
    return Report("glass", figures, [{name: percent for name, (_, percent) in displayed.items()}])


def _ages_ms(stamps: Mapping[int, float], shown: Mapping[int, float]) -> np.ndarray:
    """Return the age of each picture when it was displayed [ms].

    Both maps contain times of the monotonic clock [s] by the number of the picture.
    """
    ages = [(at - stamps[number]) * 1000.0 for number, at in shown.items() if number in stamps]
    if not ages:
        raise SystemExit(f"the page displayed none of the node's {len(stamps)} pictures")
    return np.array(ages)


def _displayed(
    lab: RunningLab, seconds: float, options: Sequence[str]
) -> tuple[dict[int, float], dict[str, float]]:
    """Open the page for `seconds` in a browser with these options, and record which pictures it displays.

    Return the time at which each picture was displayed first, by the number of the picture, and the processor load.
    """
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium") or "/usr/bin/chromium",
            args=["--no-sandbox", *options],
        )
        try:
            page = browser.new_page(viewport={"width": 1440, "height": 900})
            page.goto(f"{lab.visitor.url}/login/")
            page.fill("input[name=username]", "operator")
            page.fill("input[name=password]", lab.announced["passwords"]["operator"])
            page.click("button[type=submit]")
            page.wait_for_url(lambda url: "/login" not in url)
            page.add_init_script(f"({_WATCH})({[CAMERA, BITS]!r})")
            page.goto(f"{lab.visitor.url}/stations/{STATION}/debug/")
            until = time.monotonic() + _SHOWN_S
            while not page.evaluate(
                "window.shown.length"
            ):  # waiting in the page needs eval, which its policy forbids
                if time.monotonic() > until:
                    raise SystemExit(f"the page shows no picture of {CAMERA} within {_SHOWN_S:g} s")
                time.sleep(0.1)
            time.sleep(_MARGIN_S)
            page.evaluate("window.shown.length = 0")
            processors = ProcessorUsage(lab.process)
            time.sleep(seconds)
            drawn: list[Any] = page.evaluate("window.shown")
            percent = processors.percent()
        finally:
            browser.close()
    offset = time.time() - time.monotonic()
    first: dict[int, float] = {}
    for number, at in drawn:
        first.setdefault(int(number), at / 1000.0 - offset)
    return first, percent
