from __future__ import annotations

import cv2
import numpy as np
import pytest

import robots
from runtime.simulation.bench import bench as benches
from runtime.simulation.bench.arm_frames import arm_frames
from runtime.simulation.bench.bench import Bench, BenchState, BlockState
from runtime.simulation.render import Renderer

ROBOT = robots.load_robot("agilex_piper")
BENCH = Bench()
HOME = ROBOT.poses["home"]
LEFT = ROBOT.group("left_arm")
DOWN = HOME.copy()  # the left arm's fingers above the work area
DOWN[:7] = [-0.433, 1.628, -1.228, 0.0, 1.2, 0.0, 0.04]
RENDERER = Renderer(ROBOT, BENCH, 640, 480)


def state(*blocks: tuple[float, float, float], plate: tuple[float, float] = (0.1, 0.36)) -> BenchState:
    return BenchState(
        tuple(BlockState(benches.block_pose(block, BENCH.block_edge)) for block in blocks), (plate,)
    )


def in_hand() -> BenchState:
    return BenchState((BlockState(benches.tip_in_world(ROBOT, LEFT, DOWN), LEFT.name),), ((0.1, 0.36),))


def orange(picture: np.ndarray) -> np.ndarray:
    """Where the task's block is, by its hue alone."""
    hsv = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
    return (hsv[..., 0] >= 3) & (hsv[..., 0] <= 14) & (hsv[..., 1] > 150) & (hsv[..., 2] > 70)


def middle(mask: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()])


def outline(camera: benches.PinholeCamera, pose: np.ndarray) -> np.ndarray:
    """The mask of a block at `pose`, from the camera's own projection."""
    half = BENCH.block_edge / 2
    corners = np.array([[x, y, z] for x in (-half, half) for y in (-half, half) for z in (-half, half)])
    pixels = camera.project(corners @ pose[:3, :3].T + pose[:3, 3])
    mask = np.zeros((camera.height, camera.width), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull((pixels * 256).round().astype(np.int32)), 1, cv2.LINE_8, 8)
    return mask.astype(bool)


def test_there_is_a_bgr_picture_for_each_camera_in_memory_of_its_own() -> None:
    first = RENDERER.draw(HOME, state((0.0, 0.3, 0.2)))
    RENDERER.draw(DOWN, in_hand())  # has no effect on what is drawn later
    second = RENDERER.draw(HOME, state((0.0, 0.3, 0.2)))
    assert list(first) == [camera.key for camera in ROBOT.cameras]
    for key, picture in first.items():
        assert picture.shape == (480, 640, 3)
        assert picture.dtype == np.uint8
        assert not np.shares_memory(picture, second[key])
        np.testing.assert_array_equal(picture, second[key])


def test_the_same_seed_draws_the_same_and_another_seed_another_table() -> None:
    seen = [
        Renderer(ROBOT, BENCH, 320, 240, seed).draw(DOWN, state((0.0, 0.3, 0.2)))["cam_high"]
        for seed in (4, 4, 5)
    ]
    np.testing.assert_array_equal(seen[0], seen[1])
    assert (seen[0] != seen[2]).mean() > 0.2


@pytest.mark.parametrize("block", [(0.0, 0.3, 0.0), (-0.2, 0.38, 0.5), (0.21, 0.2, -0.7)])
def test_the_block_is_where_the_overhead_camera_projects_it(block: tuple[float, float, float]) -> None:
    camera = benches.overhead_camera(640, 480)
    wanted = outline(camera, benches.block_pose(block, BENCH.block_edge))
    seen = orange(RENDERER.draw(HOME, state(block, plate=(0.0, 0.5)))["cam_high"])
    assert np.linalg.norm(middle(seen) - middle(wanted)) < 1.0
    assert (seen & wanted).sum() / (seen | wanted).sum() > 0.9


def test_no_block_is_seen_where_there_is_none_wherever_the_arms_are() -> None:
    chance = np.random.default_rng(7)
    for _ in range(12):
        q = chance.uniform(ROBOT.lower, ROBOT.upper)
        assert not any(orange(picture).any() for picture in RENDERER.draw(q, state()).values())


def test_no_picture_is_black_or_plain_wherever_the_arms_are() -> None:
    chance = np.random.default_rng(8)
    for q in [HOME, DOWN, *chance.uniform(ROBOT.lower, ROBOT.upper, (20, ROBOT.dim))]:
        high, *wrists = RENDERER.draw(q, state((0.0, 0.3, 0.2))).values()
        assert high.mean() > 90
        assert all(picture.std() > 4 and picture.mean() > 15 for picture in (high, *wrists))


def test_a_held_block_is_between_the_fingers_in_the_picture_of_its_wrist_only() -> None:
    pictures = RENDERER.draw(DOWN, in_hand())
    tip = benches.tip_in_world(ROBOT, LEFT, DOWN)
    camera = benches.cameras(ROBOT, DOWN, 640, 480)["cam_left_wrist"]
    seen = orange(pictures["cam_left_wrist"])
    assert np.linalg.norm(middle(seen) - camera.project(tip[:3, 3])) < 25
    assert not orange(pictures["cam_right_wrist"]).any()
    jaw = BENCH.block_edge / 2 + 0.0125  # the middle of each finger
    for side in (-jaw, jaw):
        finger = camera.project((tip @ [-0.014, side, -0.01, 1.0])[:3])
        column, row = finger.round().astype(int)
        assert not seen[row, column]
        assert np.ptp(pictures["cam_left_wrist"][row, column].astype(int)) < 14  # grey metal, no brown wood


def test_an_arm_hides_the_block_under_it_from_above() -> None:
    camera = benches.overhead_camera(640, 480)
    column, row = camera.project(arm_frames(ROBOT)[LEFT.name].eef(DOWN)[:3, 3])
    there = state((*camera.pixel_to_table(column, row, BENCH.block_edge), 0.0), plate=(0.2, 0.36))
    hidden = orange(RENDERER.draw(DOWN, there)["cam_high"]).sum()
    free = orange(RENDERER.draw(HOME, there)["cam_high"]).sum()
    assert free > 500
    assert hidden < 0.2 * free


def test_things_cast_shadows_on_the_table_beside_them() -> None:
    camera = benches.overhead_camera(640, 480)
    column, row = camera.project(np.array([0.026, 0.29, 0.0])).round().astype(int)
    bare, shaded = (
        RENDERER.draw(HOME, some)["cam_high"][row - 1 : row + 2, column - 1 : column + 2].mean()
        for some in (state(plate=(-0.2, 0.3)), state((0.0, 0.3, 0.0), plate=(-0.2, 0.3)))
    )
    assert shaded < 0.85 * bare


def test_the_plate_lies_where_it_is_said_to_and_a_block_can_lie_on_it() -> None:
    camera = benches.overhead_camera(640, 480)
    plate = (-0.05, 0.3)
    on_plate = benches.block_pose((*plate, 0.3), BENCH.block_edge)
    on_plate[2, 3] += BENCH.discs[0].height
    picture = RENDERER.draw(HOME, BenchState((BlockState(on_plate),), (plate,)))["cam_high"]
    rim = BENCH.discs[0].radius * 0.965
    for x, y in ((rim, 0), (-rim, 0), (0, rim), (0, -rim)):
        column, row = (
            camera.project(np.array([plate[0] + x, plate[1] + y, BENCH.discs[0].height])).round().astype(int)
        )
        blue, green, red = picture[row, column].astype(int)
        assert blue > green + 30 > red + 30
    seen, wanted = orange(picture), outline(camera, on_plate)
    assert (seen & wanted).sum() / (seen | wanted).sum() > 0.9


def test_several_blocks_have_their_own_colours() -> None:
    places = [(-0.15, 0.2, 0.0), (-0.05, 0.2, 0.0), (0.05, 0.2, 0.0), (0.15, 0.2, 0.0)]
    picture = RENDERER.draw(HOME, state(*places, plate=(0.0, 0.36)))["cam_high"]
    camera = benches.overhead_camera(640, 480)
    hues = []
    for x, y, _ in places:
        column, row = camera.project(np.array([x, y, BENCH.block_edge])).round().astype(int)
        hues.append(
            int(cv2.cvtColor(picture[row : row + 1, column : column + 1], cv2.COLOR_BGR2HSV)[0, 0, 0])
        )
    assert np.diff(sorted(hues)).min() > 8


@pytest.mark.some(1)
@pytest.mark.parametrize("size", [(64, 48), (321, 239), (1280, 720)])
def test_any_size_is_drawn(size: tuple[int, int]) -> None:
    pictures = Renderer(ROBOT, BENCH, *size).draw(DOWN, in_hand())
    assert {picture.shape for picture in pictures.values()} == {(size[1], size[0], 3)}
    assert orange(pictures["cam_left_wrist"]).mean() > 0.02
