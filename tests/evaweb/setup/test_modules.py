"""Drawings of benches, positions that are generated, and the projection onto pictures: run by Node."""

from __future__ import annotations

from typing import Any

import pytest

from evaweb.setup.editing import sizes_of
from runtime.benches.schema import load_schema
from tests.evaweb.console.test_modules import pytestmark, run

__all__ = ["pytestmark"]
BENCH, GENERATE, PLANE = ("../setup/bench.js", "../setup/generate.js", "../setup/plane.js")
LAID = {"block": [-0.14, 0.26, 20], "plate": [0.08, 0.34]}
AREA = [-220, 220, 180, 400]
SIZES = sizes_of(load_schema("tabletop"))


def call(module: str, name: str, *given: Any) -> Any:
    return run(module, f"return m.{name}(...given);", list(given))


def generated(**asked: Any) -> Any:
    whole = {"bench": LAID, "sizes": SIZES, "keys": ["block"], "area": AREA, "turn": 45, "seed": 7, **asked}
    return call(GENERATE, "generated", whole)


def test_what_lies_there_is_in_millimetres_and_is_put_elsewhere() -> None:
    cup = {"objects": {"cup": [0.0, 0.3, 0, 0.08, 0.06]}}
    plate, block, other = call(BENCH, "things", {**LAID, **cup}, SIZES)
    assert (plate["kind"], plate["x"], plate["y"], plate["width"]) == ("plate", 80, 340, 150)
    assert (block["kind"], block["x"], block["y"], block["yaw"], block["depth"]) == (
        "block",
        -140,
        260,
        20,
        40,
    )
    assert (other["name"], other["width"], other["depth"]) == ("cup", 80, 60)
    moved = call(BENCH, "placed", LAID, block, {"x": 51.26, "yaw": 200})
    assert moved == {"block": [0.0513, 0.26, -160], "plate": [0.08, 0.34]}
    wider = call(BENCH, "placed", cup, other, {"width": 100})
    assert wider == {"objects": {"cup": [0.0, 0.3, 0, 0.1, 0.06]}}
    assert call(BENCH, "without", {**LAID, **cup}, other) == {**LAID, "objects": {}}
    assert call(BENCH, "without", LAID, block) == {"plate": [0.08, 0.34]}


@pytest.mark.parametrize(
    ("pressed", "change"),
    [
        ({"key": "ArrowLeft"}, {"x": -150, "y": 260}),
        ({"key": "ArrowUp", "shiftKey": True}, {"x": -140, "y": 261}),
        ({"key": "PageUp"}, {"yaw": 25}),
        ({"key": "PageDown", "shiftKey": True}, {"yaw": 19}),
        ({"key": "Enter"}, None),
        ({"key": "ArrowLeft", "altKey": True}, None),
    ],
)
def test_keys_move_and_turn_what_lies_there(pressed: dict[str, Any], change: dict[str, float] | None) -> None:
    _, block = call(BENCH, "things", LAID, SIZES)
    assert call(BENCH, "stepped", block, pressed) == change
    plate = {**block, "round": True}
    assert call(BENCH, "stepped", plate, {"key": "PageUp"}) is None


def test_what_is_moved_stays_in_the_area_but_things_of_ones_own() -> None:
    _, block = call(BENCH, "things", LAID, SIZES)
    right, far = SIZES["area"][1], SIZES["area"][3]
    assert call(BENCH, "moved", LAID, block, {"x": 9000, "y": 9000}, SIZES)["block"] == [right, far, 20]
    cup = {"objects": {"cup": [0.0, 0.3, 0, 0.08, 0.06]}}
    (thing,) = call(BENCH, "things", cup, SIZES)
    assert call(BENCH, "moved", cup, thing, {"x": 900}, SIZES)["objects"]["cup"][0] == 0.9


def test_corners_of_what_is_turned_are_where_they_are_seen() -> None:
    thing = {"round": False, "x": 100, "y": 200, "yaw": 90, "width": 40, "depth": 20}
    corners = call(BENCH, "outline", thing)
    assert sorted([round(x), round(y)] for x, y in corners) == [[90, 180], [90, 220], [110, 180], [110, 220]]
    assert len(call(BENCH, "outline", {**thing, "round": True})) == 32


def test_a_position_in_words_alone_shows_its_reference_picture_if_there_is_one() -> None:
    view = {"x": 0, "y": 0, "width": 400, "height": 300}
    assert "in words" in call(BENCH, "thumbnail", None, SIZES, view, "")
    assert 'href="/pictures/a.jpg"' in call(BENCH, "thumbnail", None, SIZES, view, "", "/pictures/a.jpg")
    assert "/pictures/a.jpg" not in call(BENCH, "thumbnail", LAID, SIZES, view, "", "/pictures/a.jpg")


@pytest.mark.parametrize(
    ("bench", "said"),
    [
        (LAID, []),
        ({"block": [0.3, 0.3, 0]}, ["block is outside the area that a simulated bench can lay out"]),
        (
            {"block": [0.0, 0.3, 0], "plate": [0.1, 0.3]},
            ["plate and block are 100 mm apart; at least 150 mm are needed"],
        ),
        (
            {"objects": {"a": [0, 0.3, 0, 0.03, 0.04], "b": [0, 0.34, 0, 0.03, 0.04]}},
            ["a and b are 40 mm apart; at least 50 mm are needed"],
        ),
        (None, []),
    ],
)
def test_what_no_bench_can_lay_is_said(bench: Any, said: list[str]) -> None:
    assert call(BENCH, "problems", bench, SIZES) == said


def test_a_name_in_a_drawing_is_text_and_not_markup() -> None:
    drawing = call(BENCH, "thumbnail", LAID, SIZES, {"x": 0, "y": 0, "width": 1, "height": 1}, '<b>"&')
    assert "<b>" not in drawing
    assert "&#60;b&#62;&#34;&#38;" in drawing


def test_a_grid_is_laid_from_end_to_end_and_leaves_out_what_cannot_be() -> None:
    made = generated(method="grid", columns=3, rows=2, bench={"block": LAID["block"]})
    assert [bench["block"][:2] for bench in made["benches"]] == [
        *([-0.22, 0.18], [0, 0.18], [0.22, 0.18]),
        *([-0.22, 0.4], [0.22, 0.4]),  # that in the middle is beyond the arms
    ]
    assert made["left"] == 1
    assert {bench["block"][2] for bench in made["benches"]} == {20}


@pytest.mark.exhaustive
def test_positions_at_random_keep_their_distance_and_a_seed_gives_the_same_again() -> None:
    made = generated(method="random", n=8, least=60)
    assert len(made["benches"]) == 8
    assert call(GENERATE, "nearest", made["benches"], SIZES) >= 60
    assert all(call(BENCH, "problems", bench, SIZES) == [] for bench in made["benches"])
    assert all(bench["plate"] == LAID["plate"] for bench in made["benches"])
    assert all(-25 <= bench["block"][2] <= 65 for bench in made["benches"])
    assert generated(method="random", n=8, least=60) == made
    assert generated(method="random", n=8, least=60, seed=8) != made
    crowded = generated(method="random", n=8, least=300)
    assert crowded["left"] == 8 - len(crowded["benches"]) > 0


def test_a_latin_hypercube_uses_each_slice_of_each_range_once() -> None:
    area = [-200, -40, 200, 360]
    made = generated(method="hypercube", n=8, area=area, bench={"block": LAID["block"]})
    assert made["left"] == 0
    for axis, (low, high) in enumerate(((-0.2, -0.04), (0.2, 0.36))):
        slices = [int((bench["block"][axis] - low) / (high - low) * 8 * 0.9999) for bench in made["benches"]]
        assert sorted(slices) == list(range(8)), axis


def test_everything_may_be_laid_anew_at_once() -> None:
    made = generated(method="hypercube", n=6, keys=["block", "plate"])
    assert len({tuple(bench["plate"]) for bench in made["benches"]}) == len(made["benches"]) >= 4
    assert all(call(BENCH, "problems", bench, SIZES) == [] for bench in made["benches"])


def test_a_projection_takes_four_corners_to_theirs_and_lines_to_lines() -> None:
    corners = [[-220, 180], [220, 180], [220, 400], [-220, 400]]
    places = [[0.2, 0.9], [0.8, 0.85], [0.7, 0.3], [0.3, 0.25]]
    body = """
        const [from, to] = given;
        const h = m.projection(from, to);
        return { corners: from.map((point) => m.seen(h, point)), middle: m.seen(h, [0, 290]) };
    """
    found = run(PLANE, body, [corners, places])
    assert [part for point in found["corners"] for part in point] == pytest.approx(
        [part for point in places for part in point]
    )
    # the diagonals of the area cross in its middle, and so do those of its picture
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = places
    share = ((bx - ax) * (by - dy) - (by - ay) * (bx - dx)) / ((cx - ax) * (by - dy) - (cy - ay) * (bx - dx))
    assert found["middle"] == pytest.approx([ax + share * (cx - ax), ay + share * (cy - ay)])
    assert call(PLANE, "projection", corners, [[0, 0], [0.1, 0.1], [0.2, 0.2], [0.3, 0.3]]) is None
