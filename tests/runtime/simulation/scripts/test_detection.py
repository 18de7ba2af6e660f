from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

import robots
from runtime.policies.pictures import resize_image, to_layout
from runtime.simulation.bench import bench
from runtime.simulation.bench.bench import (
    Bench,
    BenchError,
    BenchLayout,
    BenchState,
    BlockState,
)
from runtime.simulation.bench.layout import draw_layout
from runtime.simulation.render import Renderer
from runtime.simulation.scripts.detection import Detection, OverheadDetector
from tests.runtime.simulation.drawn_bench import BENCH, CAMERA, drawn

ROBOT = robots.load_robot("agilex_piper")
EYE = OverheadDetector(ROBOT)
LAYOUT = BenchLayout(((-0.12, 0.25, 0.3),), ((0.05, 0.33),))


def letterboxed(picture):
    return to_layout(resize_image(picture, 224, 224, "pad"), "chw")


def assert_seen(sight, layout, within=0.003, turn=0.07):
    x, y, yaw = layout.blocks[0]
    assert sight.block is not None
    assert sight.plate is not None
    assert math.dist(sight.block[:2], (x, y)) < within
    assert abs(math.remainder(sight.block[2] - yaw, math.pi / 2)) < turn
    assert math.dist(sight.plate, layout.discs[0]) < within


def test_it_looks_through_the_camera_that_is_on_no_arm():
    assert EYE.key == "cam_high"
    blind = replace(ROBOT, cameras=tuple(camera for camera in ROBOT.cameras if camera.key != EYE.key))
    with pytest.raises(BenchError, match="no camera above the bench"):
        OverheadDetector(blind)


@pytest.mark.parametrize("seed", range(12))
def test_block_and_plate_are_found_in_the_picture_that_a_policy_is_sent(seed):
    layout = draw_layout(seed)
    assert_seen(EYE.detect(letterboxed(drawn(layout))), layout)


@pytest.mark.some(1)
@pytest.mark.parametrize("seed", range(4))
def test_block_and_plate_are_found_in_rendered_pictures(seed):
    layout = draw_layout(100 + seed)
    blocks = tuple(BlockState(bench.block_pose(block, BENCH.block_edge)) for block in layout.blocks)
    state = BenchState(blocks, layout.discs)
    picture = Renderer(ROBOT, Bench(), 640, 480).draw(ROBOT.poses["ready"], state)[EYE.key][..., ::-1]
    assert_seen(EYE.detect(letterboxed(np.ascontiguousarray(picture))), layout)


@pytest.mark.parametrize("size", [(480, 640), (240, 320), (224, 224), (300, 500), (500, 300)])
@pytest.mark.parametrize("how", ["pad", "stretch"])
@pytest.mark.parametrize("order", ["chw", "hwc"])
def test_the_size_and_the_layout_of_the_picture_do_not_matter(size, how, order):
    assert_seen(EYE.detect(to_layout(resize_image(drawn(LAYOUT), *size, how), order)), LAYOUT)


@pytest.mark.parametrize("light", [0.6, 0.8, 1.08])
def test_the_light_does_not_matter(light):
    assert_seen(EYE.detect(letterboxed(drawn(LAYOUT, light=light))), LAYOUT)


def test_a_block_on_the_plate_is_found_there():
    layout = BenchLayout(((0.05, 0.33, 0.2),), ((0.05, 0.33),))
    sight = EYE.detect(letterboxed(drawn(layout, BENCH.discs[0].height)))
    assert_seen(sight, layout, within=0.006, turn=0.1)


def test_nothing_is_seen_in_the_dark():
    assert EYE.detect(np.zeros((3, 224, 224), np.uint8)) == Detection(dark=True)


def test_an_empty_table_has_a_plate_at_most():
    sight = EYE.detect(letterboxed(drawn(BenchLayout((), LAYOUT.discs))))
    assert sight.block is None
    assert sight.plate == pytest.approx(LAYOUT.discs[0], abs=0.003)
    assert EYE.detect(np.full((3, 224, 224), 128, np.uint8)) == Detection()


@pytest.mark.parametrize("thing", ["block", "plate"])
def test_what_is_covered_in_part_is_not_seen(thing):
    place = LAYOUT.blocks[0][:2] if thing == "block" else LAYOUT.discs[0]
    u, v = CAMERA.project(np.array([*place, BENCH.block_edge / 2]))
    picture = drawn(LAYOUT)
    cv2.rectangle(picture, (int(u), int(v) - 90), (int(u) + 90, int(v) + 90), (230, 230, 230), -1)
    sight = EYE.detect(letterboxed(picture))
    assert getattr(sight, thing) is None
    assert getattr(sight, "plate" if thing == "block" else "block") is not None


def test_a_picture_of_another_shape_is_refused():
    with pytest.raises(BenchError, match=r"\(224, 224, 4\) was given; allowed: \[H, W, 3\] or \[3, H, W\]"):
        EYE.detect(np.zeros((224, 224, 4), np.uint8))


def test_a_solid_disc_of_the_rims_colour_is_no_plate():
    picture = np.tile(np.uint8(BENCH.table_colour), (480, 640, 1))
    u, v = CAMERA.project(np.array([*LAYOUT.discs[0], BENCH.discs[0].height]))
    edge, _ = CAMERA.project(
        np.array([LAYOUT.discs[0][0] + BENCH.discs[0].radius, LAYOUT.discs[0][1], BENCH.discs[0].height])
    )
    colour = tuple(int(part) for part in BENCH.discs[0].rim_colour)
    cv2.circle(picture, (round(u), round(v)), round(edge - u - 4), colour, 8)
    assert EYE.detect(letterboxed(picture)).plate == pytest.approx(LAYOUT.discs[0], abs=0.01)
    cv2.circle(picture, (round(u), round(v)), round(edge - u - 4), colour, cv2.FILLED)
    assert EYE.detect(letterboxed(picture)).plate is None
