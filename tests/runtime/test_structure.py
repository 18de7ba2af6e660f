"""What may import what, read off the source."""

import ast
import re
import subprocess
import sys

import pytest

from tests.sources import ROOT, Sources

GROUND_FLOOR = {"types", "clock", "messages", "codecs", "errors", "section", "memory"}
# By these alone the web comes in; to read a deployment file belongs to the configuration.
DOORS = {
    "messages",
    "bus",
    "config",
    "deployment",
    "kinematics",
    "recording",
    "datasets",
    "preflight",
    "quality",
}
FAMILY = {"control", "main", "reception", "media", "guard", "headless"}
ROOF = FAMILY | {"lockstep", "served_lockstep", "supervisor", "ctl", "terminal", "channel", "__main__"}


SOURCES = Sources("runtime", "robots")
MODULES = SOURCES.paths
imports, inside = SOURCES.imports, SOURCES.inside


def floor(module):
    return module.split(".")[1] if "." in module else ""


def test_the_modules_were_found():
    assert {"runtime.tick", "runtime.transports.zmq", "robots.loading", "runtime"} <= set(MODULES)
    assert "runtime.clock" in inside("runtime.tick") | inside("runtime.main")


def test_imports_of_types_alone_and_inside_functions_are_told_apart(tmp_path, monkeypatch):
    path = tmp_path / "sample.py"
    path.write_text(
        "from typing import TYPE_CHECKING\n"
        "import a.b\n"
        "from .c import d\n"
        "try:\n    import e\nexcept ImportError:\n    pass\n"
        "if TYPE_CHECKING:\n    import f\nelse:\n    import g\n"
        "def h():\n    import i\n"
        "class J:\n    import k\n",
        "utf-8",
    )
    monkeypatch.setitem(MODULES, "runtime.sample", path)
    top = {"typing", "typing.TYPE_CHECKING", "a.b", "runtime.c", "runtime.c.d", "e", "g", "k"}
    assert imports("runtime.sample") == top
    assert imports("runtime.sample", True) == top | {"i"}


@pytest.mark.parametrize("module", sorted(MODULES))
def test_neither_the_web_framework_nor_the_web_is_imported(module):
    named = {name.partition(".")[0] for name in imports(module, True)}
    assert not named & {"django", "evaweb", "channels", "celery", "rest_framework"}


@pytest.mark.parametrize("module", sorted(m for m in MODULES if m.partition(".")[0] == "robots"))
def test_the_robots_know_nothing_of_the_runtime(module):
    assert not {name for name in imports(module, True) if name.partition(".")[0] == "runtime"}


@pytest.mark.parametrize("module", sorted(m for m in MODULES if floor(m) in GROUND_FLOOR))
def test_the_ground_floor_stands_on_nothing_above_it(module):
    assert {floor(name) for name in inside(module, True) if name != "runtime"} <= GROUND_FLOOR


@pytest.mark.parametrize("module", sorted(m for m in MODULES if floor(m) not in ROOF | {"sim"}))
def test_nothing_below_the_roof_imports_a_process(module):
    assert not {name for name in inside(module, True) if floor(name) in ROOF}


@pytest.mark.parametrize("module", sorted(m for m in MODULES if floor(m) not in ROOF | {"sim"}))
def test_nothing_but_the_roof_knows_the_stand_ins(module):
    assert not {name for name in inside(module, True) if floor(name) == "sim"}


def test_no_import_goes_round_in_a_circle():
    assert SOURCES.circle() == []


def behind_the_doors(path):
    """Lines of a file of the web that enter the runtime where there is no door."""
    tree = ast.parse(path.read_text("utf-8"))
    for node in ast.walk(tree):
        if not isinstance(node, ast.Import | ast.ImportFrom):
            continue
        names = [alias.name for alias in node.names]
        if isinstance(node, ast.ImportFrom):
            # `from runtime import bus` enters by bus; `from .runtime import x` is a module of the web's own.
            names = [] if node.level else names if node.module == "runtime" else [node.module]
            names = [f"runtime.{name}" for name in names] if node.module == "runtime" else names
        for name in names:
            package, _, rest = name.partition(".")
            if package == "runtime" and rest.partition(".")[0] not in DOORS:
                yield f"{path.name}:{node.lineno}: {name}"


def test_the_web_enters_the_runtime_by_its_doors_alone():
    found = [line for path in sorted((ROOT / "evaweb").rglob("*.py")) for line in behind_the_doors(path)]
    assert found == []


@pytest.mark.parametrize("door", sorted(DOORS))
def test_every_door_is_there(door):
    assert f"runtime.{door}" in MODULES


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("import runtime.session", "runtime.session"),
        ("import os, runtime.sim.node as node", "runtime.sim.node"),
        ("import runtime", "runtime"),
        ("from runtime import bus, client", "runtime.client"),
        ("from runtime.client import StationClient", "runtime.client"),
        ("from runtime.errors import RuntimeFault", "runtime.errors"),
        ("from runtime.transports.zmq import Config", "runtime.transports.zmq"),
        ("def view():\n    from runtime.busy import x", "runtime.busy"),
        ("if TYPE_CHECKING:\n    from runtime.types import Observation", "runtime.types"),
    ],
)
def test_who_comes_in_beside_the_doors_is_found(tmp_path, line, found):
    path = tmp_path / "views.py"
    path.write_text(f"{line}\n", "utf-8")
    assert [one.rpartition(" ")[2] for one in behind_the_doors(path)] == [found]


@pytest.mark.parametrize(
    "line",
    [
        "from runtime import bus, messages",
        "from runtime.bus import CommandClient",
        "import runtime.datasets.catalog",
        "from runtime.recording.reader import open_episode",
        "from .runtime import anything",
        "import runtimes",
        "import robots",
    ],
)
def test_who_comes_in_by_a_door_is_let_in(tmp_path, line):
    path = tmp_path / "views.py"
    path.write_text(f"{line}\n", "utf-8")
    assert list(behind_the_doors(path)) == []


ROBOTS = sorted(path.parent.name for path in (ROOT / "robots").glob("*/robot.toml"))


@pytest.mark.parametrize("module", sorted(m for m in MODULES if m.partition(".")[0] == "runtime"))
def test_nothing_in_the_runtime_names_a_robot(module):
    assert ROBOTS
    names = {name for robot in ROBOTS for name in (robot, robot.replace("_", "-"), robot.replace("_", " "))}
    pattern = re.compile("|".join(map(re.escape, sorted(names))), re.IGNORECASE)
    assert pattern.findall(MODULES[module].read_text("utf-8")) == []


def run(code):
    return subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout


@pytest.mark.parametrize(
    "module", ["runtime.config", "runtime.control", "runtime.reception", "runtime.guard", "runtime.ctl"]
)
def test_what_control_and_the_terminal_import_is_free_of_codecs_and_tables(module):
    heavy = ["av", "pyarrow", "PIL", "websockets", "simplejpeg"]
    assert run(f"import sys, {module}; print([m for m in {heavy} if m in sys.modules])").strip() == "[]"
