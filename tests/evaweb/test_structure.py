"""The apps of the web stand on floors, and imports run downwards."""

from pathlib import Path

import pytest

from tests.sources import Sources

# Who stands on whom; those of one floor do not know each other, but for the ground, where only circles are wrong.
FLOORS = (
    "cells remembered errors environment roles frames lock_wait celery settings refusals administration apps "
    "statistics guards sight sight_tags",
    "stations",
    "jobs",
    "episodes",
    "reviews",
    "trials collect",
    "plans",
    "results preflights datasets",
    "console api",
    "lab",
    "asgi urls",
    "management",
)
FLOOR_OF = {name: number for number, names in enumerate(FLOORS) for name in names.split()}
SOURCES = Sources("evaweb")
MODULES = sorted(set(SOURCES.paths) - {"evaweb"})


def room(module):
    """The app or the module right below evaweb; programs that are started stand on the roof whatever their app."""
    parts = module.split(".")
    return "management" if "management" in parts else parts[1]


def upwards(sources, module):
    """What it imports, anywhere in it, from its own floor or one above, without its own app."""
    here, own = FLOOR_OF[room(module)], room(module)
    for name in sorted(sources.inside(module, everywhere=True) - {"evaweb"}):
        above = FLOOR_OF[room(name)] > here or FLOOR_OF[room(name)] == here > 0
        if above and room(name) != own:
            yield f"{module} -> {name}"


def test_the_modules_were_found():
    assert {"evaweb.errors", "evaweb.trials.services", "evaweb.lab.management.commands.lab"} <= set(MODULES)
    assert "evaweb.stations.commands" in SOURCES.inside("evaweb.trials.bench")


@pytest.mark.parametrize("module", MODULES)
def test_every_module_has_its_floor_and_imports_run_downwards(module):
    assert room(module) in FLOOR_OF, f"{module}: write down on which floor it stands"
    assert list(upwards(SOURCES, module)) == []


def test_no_import_goes_round_in_a_circle():
    assert SOURCES.circle() == []


def test_even_inside_functions_no_import_goes_round_in_a_circle(monkeypatch):
    whole = Sources("evaweb")
    monkeypatch.setattr(whole, "inside", lambda module: SOURCES.inside(module, everywhere=True))
    assert whole.circle() == []


def planted(folder: Path, **modules: str) -> Sources:
    """A web of these modules, `app__module`."""
    for name, code in modules.items():
        path = folder / "evaweb" / f"{name.replace('__', '/')}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(code, "utf-8")
    return Sources("evaweb", root=folder)


@pytest.mark.parametrize(
    ("module", "code"),
    [
        ("stations__selectors", "from evaweb.trials.models import Trial"),
        ("stations__selectors", "from evaweb.trials import models"),
        ("stations__selectors", "def late():\n    import evaweb.trials.models"),
        ("jobs__services", "from ..trials.models import Trial"),
        ("trials__services", "from evaweb.console import hub"),
        ("api__stations", "from evaweb.console.hub import Hub"),
        ("console__views", "from evaweb.lab.seed import demo_scene"),
        ("errors", "from evaweb.stations import models"),
        ("console__views", "from evaweb.asgi import application"),
        ("api__views", "from evaweb.lab.management.commands import lab"),
    ],
)
def test_who_looks_upwards_is_found(tmp_path, module, code):
    names = ("trials__models", "console__hub", "lab__seed", "stations__models", "asgi")
    others = dict.fromkeys((*names, "lab__management__commands__lab"), "")
    sources = planted(tmp_path, **others, **{module: code})
    looked = "evaweb." + module.replace("__", ".")
    assert [line.partition(" -> ")[0] for line in upwards(sources, looked)] == [looked]


@pytest.mark.parametrize(
    ("module", "code"),
    [
        ("trials__services", "from evaweb.stations.models import Station"),
        ("trials__services", "from evaweb.trials import models\nfrom evaweb.errors import EvaError"),
        ("lab__management__commands__lab", "from evaweb.asgi import application"),
        ("roles", "from evaweb.errors import NotAllowed"),
        ("console__views", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import evaweb.lab.seed"),
    ],
)
def test_who_looks_downwards_is_let_be(tmp_path, module, code):
    others = dict.fromkeys(("stations__models", "trials__models", "errors", "asgi", "lab__seed"), "")
    sources = planted(tmp_path, **others, **{module: code})
    assert list(upwards(sources, "evaweb." + module.replace("__", "."))) == []


def test_a_circle_is_found(tmp_path):
    sources = planted(
        tmp_path,
        jobs__services="from evaweb.jobs import doorbell",
        jobs__doorbell="from evaweb.jobs import tasks",
        jobs__tasks="from evaweb.jobs.services import work",
    )
    assert {"evaweb.jobs.services", "evaweb.jobs.doorbell", "evaweb.jobs.tasks"} == set(sources.circle())
