"""The bench is compared by regions: present is told from absent and from moved by 20 pixels."""

import os
from pathlib import Path

import av
import numpy as np
import pytest
import simplejpeg

from evaweb.core.errors import EvaError
from evaweb.plans import image_store
from evaweb.plans.region_matching import (
    Region,
    _words,
    check_sizes,
    match_regions,
    regions_of,
)

HEIGHT, WIDTH = 480, 640
LEAST = 0.75  # what the administrator's page proposes


def encoded(picture, quality=85):
    pixels = np.ascontiguousarray(np.clip(picture, 0, 255).astype(np.uint8))
    return simplejpeg.encode_jpeg(pixels, quality=quality)


def region(x, y, width, height, name="block"):
    return Region(name=name, x=x / WIDTH, y=y / HEIGHT, width=width / WIDTH, height=height / HEIGHT)


def bench(x=300, y=200, colour=(190, 60, 50), size=(HEIGHT, WIDTH)):
    """A table under uneven light, with a block of 40 x 36 pixels at x, y, or none; and a plate that stays."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    light = 150 + 40 * rows / HEIGHT + 30 * columns / WIDTH
    picture = np.repeat(light[..., None], 3, axis=2)
    picture[(rows - 120) ** 2 + (columns - 120) ** 2 < 60**2] = (120, 170, 150)
    if x is not None:
        picture[y : y + 36, x : x + 40] = colour
        picture[y : y + 12, x : x + 40] = np.array(colour) * 1.2
    return picture + np.random.default_rng(5).normal(0, 1.5, picture.shape)


BLOCK = region(288, 188, 64, 60)


def look(now, reference=None, quality=85, drawn=BLOCK):
    return match_regions(
        [drawn], encoded(bench() if reference is None else reference), encoded(now, quality)
    )[0]


def noisy(picture, sigma):
    return picture + np.random.default_rng(3).normal(0, sigma, picture.shape)


PRESENT = {
    "brighter": lambda p: p * 1.2,
    "darker": lambda p: p * 0.8,
    "less contrast": lambda p: (p - 128) * 0.6 + 128,
    "more contrast": lambda p: (p - 128) * 1.4 + 128,
    "noise 5": lambda p: noisy(p, 5),
    "noise 10": lambda p: noisy(p, 10),
    "darker, noise 10": lambda p: noisy(p * 0.8, 10),
    "camera 3 px": lambda p: np.roll(p, (2, 3), (0, 1)),
}


@pytest.mark.parametrize("kind", PRESENT)
def test_a_block_in_its_place_matches_whatever_the_light_and_the_sensor(kind):
    row = look(PRESENT[kind](bench()), quality=60)
    assert row["match"] > 0.9
    assert row["words"] == "in its place"


def test_a_block_that_is_not_there_does_not_match_although_the_whole_picture_does():
    row = look(bench(x=None))
    assert image_store.image_match(encoded(bench()), encoded(bench(x=None))) > 0.94
    assert row["match"] < 0.5
    assert (row["dx"], row["dy"], row["words"]) == (None, None, "not recognised here or nearby")


@pytest.mark.parametrize(
    ("x", "y", "said"),
    [
        (320, 200, "20 px to the right"),
        (280, 200, "20 px to the left"),
        (300, 220, "20 px down"),
        (300, 180, "20 px up"),
        (314, 186, "14 px to the right, 14 px up"),
    ],
)
def test_a_block_that_was_moved_by_20_pixels_does_not_match_and_it_is_said_where_to(x, y, said):
    row = look(bench(x, y))
    assert row["match"] < 0.55
    assert abs(row["dx"] - (x - 300)) <= 1
    assert abs(row["dy"] - (y - 200)) <= 1
    assert _words(x - 300, y - 200) == said


def test_a_block_of_another_colour_and_a_trace_of_one_do_not_match():
    assert look(bench(colour=(60, 130, 60)))["match"] < 0.6
    trace = 0.85 * bench(x=None) + 0.15 * bench()
    assert look(trace)["match"] < 0.6


def test_a_camera_of_more_pixels_is_compared_at_640_and_said_in_its_own():
    large = [np.kron(picture, np.ones((3, 3, 1))) for picture in (bench(), bench(320))]
    row = look(large[1], reference=large[0])
    assert row["match"] < 0.55
    assert abs(row["dx"] - 60) <= 3
    assert look(large[0])["match"] > 0.9  # the reference is of another size


@pytest.mark.parametrize(("x", "y"), [(0, 0), (580, 0), (0, 430), (580, 430)])
def test_regions_at_the_edges_of_the_picture_are_compared_too(x, y):
    drawn = region(x, y, 60, 50)
    block = bench(min(x + 10, 600), min(y + 8, 440))
    assert look(block, reference=block, drawn=drawn)["match"] > 0.99
    assert look(bench(x=None), reference=block, drawn=drawn)["match"] < 0.5


def test_regions_that_cannot_be_are_refused_and_named():
    good = {"name": "block", "x": 0.1, "y": 0.1, "width": 0.2, "height": 0.2}
    assert regions_of([good])[0].name == "block"
    for given, said in (
        ([good | {"x": 0.9}], "beyond the picture"),
        ([good | {"name": ""}], "at least 1 character"),
        ([good | {"width": float("nan")}], "finite"),
        ([good | {"depth": 1}], "not permitted"),
        ([good, good], "'block' is there twice"),
        ([good | {"name": str(k)} for k in range(13)], "at most 12"),
        ("block", "valid list"),
    ):
        with pytest.raises(EvaError, match=said):
            regions_of(given)
    with pytest.raises(EvaError, match=r"region 'block': 6 x 60 pixels of the picture; allowed: 8 x 8"):
        check_sizes([region(288, 188, 6, 60)], encoded(bench()))
    with pytest.raises(EvaError, match="region 'block' is of one colour"):
        check_sizes([region(450, 300, 64, 60)], encoded(bench()))
    check_sizes([BLOCK], encoded(bench()))


def test_a_live_picture_in_which_a_region_has_no_pixel_is_refused_and_named():
    drawn = region(297, 196, 8, 8)
    with pytest.raises(EvaError, match="region 'block' has no pixel in a picture of 64 x 48; allowed: "):
        look(bench()[::10, ::10], drawn=drawn)
    assert look(bench()[::2, ::2], drawn=drawn)["match"] >= 0


def test_a_small_file_that_is_a_very_large_picture_is_refused_before_it_is_decoded(monkeypatch):
    large = simplejpeg.encode_jpeg(np.zeros((4100, 4100, 1), "u1"), colorspace="GRAY")
    monkeypatch.setattr(simplejpeg, "decode_jpeg", lambda *given, **named: pytest.fail("decoded"))
    with pytest.raises(EvaError, match="a picture of 4100 x 4100 pixels; allowed: 16777216 pixels in all"):
        image_store.image_match(large, large)
    with pytest.raises(EvaError, match="4100 x 4100 pixels"):
        check_sizes([], large)
    small = simplejpeg.encode_jpeg(np.zeros((8, 8, 1), "u1"), colorspace="GRAY")
    monkeypatch.undo()
    with pytest.raises(EvaError, match="this is no JPEG: its JPEG has 101 scans; allowed: 64"):
        image_store.image_match(small + 100 * b"\xff\xda", small)


# --- the real episode ----------------------------------------------------------------------------------------

SAMPLE = os.environ.get("EVA_SAMPLE_EPISODE")
# Objects of the episode as they lie in its first frame: left, top, width, height.
OBJECTS = {
    "red cube": (72, 140, 64, 62),
    "green cube": (184, 142, 50, 56),
    "mug": (38, 196, 96, 102),
    "plate": (306, 196, 160, 124),
    "spoon": (176, 230, 52, 108),
    "yellow cup": (132, 340, 102, 116),
    "mango": (24, 336, 104, 144),
}


@pytest.fixture(scope="module")
def frames():
    """Its first frame, those 5, 10 and 20 later, and the last, in which the red cube lies elsewhere."""
    file = next(Path(SAMPLE).glob("videos/*/observation.images.cam_high/*.mp4"))
    with av.open(str(file)) as video:
        found = [frame.to_ndarray(format="rgb24").astype(float) for frame in video.decode(video=0)]
    return [found[k] for k in (0, 5, 10, 20, -1)]


def without(first, last, name):
    """The first frame without the object: from the last where it is not there, else what lies around it, drawn in."""
    x, y, width, height = OBJECTS[name]
    bare = first.copy()
    if name == "red cube":
        wide = np.s_[y - 6 : y + height + 6, x - 6 : x + width + 6]
        bare[wide] = last[wide]
        return bare
    left, right = first[y : y + height, x - 4], first[y : y + height, x + width + 3]
    share = np.linspace(0, 1, width)[None, :, None]
    bare[y : y + height, x : x + width] = left[:, None] * (1 - share) + right[:, None] * share
    return bare


def margin(name, frames):
    """Lowest match of what is present, and the highest of what is absent or moved by 20 pixels, with the whole's."""
    first, *later, last = frames
    x, y, width, height = OBJECTS[name]
    drawn = region(x, y, width, height, name)
    bare, shown = without(first, last, name), [*later]
    shown += [change(later[1]) for change in PRESENT.values()]
    changed = [bare]
    for dx, dy in ((20, 0), (-20, 0), (0, 20), (0, -20), (14, 14)):
        if x + dx >= 0 and y + dy + height <= HEIGHT:
            moved = bare.copy()
            moved[y + dy : y + dy + height, x + dx : x + dx + width] = first[y : y + height, x : x + width]
            changed.append(moved)
    present = [look(one, first, quality, drawn)["match"] for one in shown for quality in (85, 60)]
    wrong = [look(one, first, 85, drawn)["match"] for one in changed]
    whole = [image_store.image_match(encoded(first), encoded(one)) for one in changed]
    return min(present), max(wrong), max(whole)


@pytest.mark.exhaustive
@pytest.mark.skipif(not SAMPLE, reason="EVA_SAMPLE_EPISODE does not name the real episode")
@pytest.mark.parametrize("name", OBJECTS)
def test_on_the_real_episode_present_and_absent_or_moved_are_far_apart(name, frames):
    present, wrong, whole = margin(name, frames)
    print(f"{name}: present {present:.3f} or more, absent or moved {wrong:.3f} or less (whole {whole:.3f})")
    assert present > LEAST + 0.05
    assert wrong < LEAST - 0.05
    assert present - wrong > 0.2
    assert whole > 0.9  # which is why the whole picture gates nothing here
