"""A bench is a folder: its schema decides which layouts a station, its node and the dashboard accept."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from runtime.benches.appearance import describe_appearance
from runtime.benches.schema import FILE, FOLDER, UnusableBench, installed_benches, load_schema
from runtime.core.errors import SetupError
from runtime.simulation.bench.bench import Bench

TABLETOP = (FOLDER / "tabletop" / FILE).read_text()


def written(folder: Path, *changes: tuple[str, str]) -> str:
    """A folder of a bench of one's own: the tabletop's with these changes."""
    text = TABLETOP
    for old, new in changes:
        assert text.count(old) >= 1, old
        text = text.replace(old, new, 1)
    (folder / FILE).write_text(text)
    return str(folder)


def test_every_bench_that_comes_with_the_program_can_be_read_and_accepts_its_examples() -> None:
    assert installed_benches() == ["aloha", "metaworld", "sorting", "tabletop"]
    for name in installed_benches():
        schema = load_schema(name)
        assert list(schema.problems({key: thing.example for key, thing in schema.objects.items()})) == []


@pytest.mark.parametrize(
    ("layout", "problems"),
    [
        ({}, []),
        ({"block": [0.1, 0.3, 45]}, []),
        ({"block": [0.1, 0.2, 0], "plate": (0.15, 0.36)}, []),
        ({"cup": [0, 0]}, ["cup: unknown object; allowed: plate, block"]),
        (
            {"block": [0.1, 0.3]},
            ["block = [0.1, 0.3]; allowed: 3 finite numbers: [x, y, yaw in degrees], in metres"],
        ),
        ({"plate": [0, float("nan")]}, ["plate = [0, nan]; allowed: 2 finite numbers: [x, y], in metres"]),
        ({"plate": [True, 0.3]}, ["plate = [True, 0.3]; allowed: 2 finite numbers: [x, y], in metres"]),
        (
            {"plate": [0.5, 0.3], "block": "here"},
            [
                "plate at x 500, y 300 mm; allowed on a simulated bench: x -220 to 220, y 180 to 400 mm",
                "block = 'here'; allowed: 3 finite numbers: [x, y, yaw in degrees], in metres",
            ],
        ),
        (
            {"block": [0.0, 0.3, 0], "plate": [0.1, 0.3]},
            ["block and plate are 100 mm apart; allowed: 150 mm or more"],
        ),
    ],
)
def test_what_a_layout_may_ask_for_is_said_by_the_schema(layout: dict, problems: list[str]) -> None:
    assert list(load_schema("tabletop").problems(layout)) == problems


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('shape = "disc"', 'shape = "cone"', "objects.plate.shape"),
        ("radius = 0.075", "radius = -1", "objects.plate.radius = -1"),
        ("radius = 0.075", "", "objects.plate.radius is missing"),
        ("rim_colour = [58, 104, 190]", "rim_colour = [58, 104, 300]", "objects.plate.rim_colour.2 = 300"),
        ("area = [-0.22, 0.22", "area = [0.22, -0.22", "each range increasing"),
        (
            'objects = ["block", "plate"]',
            'objects = ["block", "cup"]',
            "allowed: two or more of plate, block, each once",
        ),
        ("example = [0.1, 0.32]", "example = [0.5, 0.32]", "the examples are no layout: plate at x 500"),
        (
            'on = "plate"',
            'on = "block"',
            "milestones.over_plate: object = 'block', on = 'block'; allowed: object one of block",
        ),
        ('when = "held"', 'when = "above"', "on one of plate"),
        ('success = ["placed"]', 'success = ["lifted"]', "success = ['lifted']; allowed: placed"),
        ('together = [["block", "plate"]]', 'together = [["block", "cup"]]', "together = ['cup']"),
        ('together = [["block", "plate"]]', 'together = [["block", "block"]]', "allowed: each object once"),
        ("area = [-0.22,", "area = [-22.0,", "allowed: within 2 m of the middle"),
        (
            "example = [0.1, 0.32]",
            "example = [0.1, 0.32]\narea = [0.2, -0.2, 0.2, 0.3]",
            "objects.plate.area = [0.2, -0.2, 0.2, 0.3]; allowed: x from, x to, y from, y to, within",
        ),
        (
            "size = [0.04, 0.04, 0.04]",
            "size = [0.04, 0.08, 0.04]",
            "size = [0.04, 0.08, 0.04]; allowed: a cube",
        ),
        (
            "high = 1.25",
            "high = 11",
            "factors.friction: low = 0.2, high = 11; allowed: 0.01 to 10",
        ),
        (
            "usual = 0\nlow = 0\nhigh = 4",
            "usual = 0.5\nlow = 0\nhigh = 4",
            "allowed: a whole number from 0 to 4",
        ),
        (
            "colours = [[40, 150, 70], [150, 70, 170], [235, 190, 40]]",
            "colours = [[226, 74, 22]]",
            "distractors.colours = [[226, 74, 22]]; allowed: one or more that no box has",
        ),
        ('title = "Block on plate"', 'title = "x" extra', "bench.toml"),
        ('title = "Block on plate"', "tilte = 1", "tilte = 1: unknown key (did you mean title?)"),
    ],
)
def test_a_file_that_cannot_be_is_refused_with_its_name_and_key(
    tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    with pytest.raises(SetupError, match=re.escape(sentence)) as refused:
        load_schema(written(tmp_path, (old, new)))
    assert str(tmp_path) in str(refused.value)


@pytest.mark.parametrize("name", ["~nobody-of-this-name", "\0", "\ud800", "x" * 5000, "", "/dev/null"])
def test_what_is_no_bench_is_refused_as_such(name: str) -> None:
    with pytest.raises(UnusableBench):
        load_schema(name)


def test_a_file_that_is_nested_too_deeply_is_refused_as_such(tmp_path: Path) -> None:
    (tmp_path / FILE).write_text("x = " + "[" * 20_000 + "]" * 20_000)
    with pytest.raises(UnusableBench, match="recursion"):
        load_schema(str(tmp_path))


def test_no_distractor_can_be_taken_for_an_object_of_the_task() -> None:
    for schema in map(load_schema, installed_benches()):
        bench, boxes = Bench(schema), len(schema.boxes)
        most = round(schema.factors["distractors"].high) if "distractors" in schema.factors else 0
        own = {bench.colour(number) for number in range(boxes)}
        others = [bench.colour(boxes + number) for number in range(most)]
        assert not own & set(others)
        drawn = describe_appearance(schema)["blocks"]
        assert [look["colour"][:3] for look in drawn] == [
            [part / 255 for part in bench.colour(number)] for number in range(boxes + most)
        ]


def test_a_digest_is_that_of_everything_a_bench_declares(tmp_path: Path) -> None:
    (tmp_path / "same").mkdir()
    (tmp_path / "other").mkdir()
    own = load_schema("tabletop").digest
    assert load_schema(written(tmp_path / "same", ("# Block on plate", "# the same"))).digest == own
    assert load_schema(written(tmp_path / "other", ("high = 1.5", "high = 1.4"))).digest != own
