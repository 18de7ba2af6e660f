"""Videos of a trial on one clock, run by Node with stand-ins for what a browser has."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

MODULE = Path(__file__).parents[4] / "static" / "result" / "videos.js"
NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="Node is not installed: the page's modules are not run")
_PAGE = """
class Video extends EventTarget {
  constructor() {
    super();
    Object.assign(this, {paused: true, ended: false, seeking: false, currentTime: 0, playbackRate: 1});
  }
  play() { this.paused = false; this.dispatchEvent(new Event("play")); return Promise.resolve(); }
  pause() { if (!this.paused) { this.paused = true; this.dispatchEvent(new Event("pause")); } }
}
const videos = [new Video(), new Video(), new Video()];
const button = given.button ? Object.assign(new EventTarget(), {hidden: true, textContent: "Play all"}) : null;
globalThis.document = {querySelectorAll: () => videos, querySelector: () => button};
const faults = [];
process.on("uncaughtException", (fault) => faults.push(String(fault)));
await import(given.module);
const playing = () => videos.map((video) => !video.paused);
const found = [];
const take = () => found.push([playing(), button?.textContent ?? null]);
"""
_HEARD = "await new Promise((heard) => setImmediate(heard));"  # what a listener threw comes after its event


def run(body, button):
    """What `found` is after `body`, and what the module complained of."""
    given = json.dumps({"module": MODULE.as_uri(), "button": button})
    script = f"const given = {given};{_PAGE}{body};{_HEARD}console.log(JSON.stringify({{found, faults}}));"
    done = subprocess.run(
        [NODE, "--input-type=module", "-e", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("button", [True, False])
def test_what_is_done_to_one_video_is_done_to_all_also_on_a_page_without_the_button(button):
    body = """
    videos[1].currentTime = 2;
    videos[1].play(); await 0; take();
    videos[2].pause(); await 0; take();
    found.push(videos.map((video) => video.currentTime));
    """
    done = run(body, button)
    assert done["faults"] == []
    says = ("Pause all", "Play all") if button else (None, None)
    assert done["found"] == [[[True] * 3, says[0]], [[False] * 3, says[1]], [2, 2, 2]]


def test_the_button_plays_and_pauses_all_and_begins_again_at_the_end():
    body = """
    const press = async () => { button.dispatchEvent(new Event("click")); await 0; take(); };
    await press(); await press();
    for (const video of videos) Object.assign(video, {currentTime: 9, ended: true});
    button.dispatchEvent(new Event("click"));
    found.push([button.hidden, videos.map((video) => video.currentTime)]);
    """
    done = run(body, True)
    assert done["faults"] == []
    assert done["found"] == [[[True] * 3, "Pause all"], [[False] * 3, "Play all"], [False, [0, 0, 0]]]
