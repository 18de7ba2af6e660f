"""A lab whose robot is no pair of arms: a head and a body that move, cameras of other names, a mesh of its own."""

import struct

import pytest

from tests.e2e.by_hand import DebugPage
from tests.e2e.conftest import SETS
from tests.e2e.lab import STATION, WIDE, Demo
from tests.e2e.pixels import moved, pixels
from tests.processes import PATIENCE_S, eventually

pytestmark = pytest.mark.slow
ROBOT, MESHED = "agibot_g2", "head_link3"


def wedge():
    """A binary STL of a wedge of 0.1 m, its normals left zero."""
    a, b, c, d = (0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1)
    faces = [(a, c, b), (a, b, d), (a, d, c), (b, c, d)]
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *sum(face, ()), 0) for face in faces)
    return bytes(80) + struct.pack("<I", len(faces)) + rows


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robots")
    mesh = folder / "meshes" / ROBOT / f"{MESHED}.stl"
    mesh.parent.mkdir(parents=True)
    mesh.write_bytes(wedge())
    lab = Demo(folder, "--robot", ROBOT, *SETS, EVA_ROBOT_MESHES=str(folder / "meshes")).start()
    yield lab
    assert lab.end() == 0, (folder / "demo.log").read_text()[-2000:]


def test_body_and_head_are_moved_drawn_recorded_and_played_back(browser, demo):
    bench = DebugPage(browser, demo, "operator", WIDE)
    fetched = []
    bench.page.on("response", lambda answer: "/meshes/" in answer.url and fetched.append(answer.status))
    bench.page.route("**/geometry*", lambda route: route.abort(), times=1)  # the web is too busy for once
    page = bench.open(f"/stations/{STATION}/debug/").page
    bench.says("#scene-note", "No 3D scene yet: the server cannot be reached. It is asked for again.")
    page.locator("#scene-note").wait_for(state="hidden")
    assert [error for error in bench.errors if "ERR_FAILED" not in error] == []
    bench.errors.clear()
    bench.take()
    bench.keys("7")
    bench.set_up()
    assert bench.cameras_live() == 3
    assert set(fetched) == {200}  # one address, however many show it
    bench.run_in("manual")
    groups = page.locator("#groups button span")
    assert groups.all_inner_texts() == ["left arm", "right arm", "head", "body"]

    before = bench.scene()
    bench.keys("Shift+A", "Shift+A", "Shift+A")
    start = bench.joints()
    assert len(start) == 5
    bench.keys("Shift+I", *["ArrowRight"] * 15)  # the last joint: all above it turns
    bench.says(".scene-tags", "nothing moves until it is sent")
    bench.press("move")
    eventually(lambda: "has arrived" in bench.said(), "the body is where it was sent")
    eventually(lambda: bench.joints()[4] == pytest.approx(start[4] + 0.15, abs=0.01), "it has turned")
    assert moved(before, bench.scene()) > 0.01
    bench.stop()

    episode = bench.snapshot()["last_run"]["uuid"]
    address = f"/replay/{episode}/"
    eventually(lambda: page.request.get(demo.url + address).ok, "the lab knows the episode", 3 * PATIENCE_S)
    bench.open(address)
    played = page.locator(".replay-scene")
    eventually(lambda: played.count() == 1, "the episode can be played", 3 * PATIENCE_S)
    page.locator("#scene-note").wait_for(state="hidden")
    first = pixels(played)
    page.locator("#scrub").press("End")
    eventually(lambda: moved(first, pixels(played)) > 0.002, "the recorded body turns")
    headings = page.locator("#joint optgroup")
    assert headings.evaluate_all("all => all.map((one) => one.label)") == groups_of(bench)
    assert bench.errors == []
    bench.close()


def groups_of(bench):
    return [name.replace("_", " ") for name in bench.snapshot()["facts"]["groups"]]
