"""A bench is a folder: its schema decides which layouts a station, its node and the dashboard accept."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from runtime.benches.schema import FILE, FOLDER, installed_benches, load_schema
from runtime.core.errors import SetupError

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
    assert installed_benches() == ["sorting", "tabletop"]
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
