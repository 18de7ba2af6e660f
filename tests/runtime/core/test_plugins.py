import importlib
import pkgutil
import sys

import pytest
from pydantic import ValidationError, create_model

from runtime.core.errors import ConfigurationError
from runtime.core.plugins import UnreadSection, kind_union, union_members, variants
from runtime.core.settings import Settings

PACKAGES = ["cameras", "kinematics", "policies", "strategies", "teleoperators", "transports"]
MODULE = """
from typing import Literal
from runtime.core.settings import Settings

class Config(Settings):
    kind: Literal["{kind}"] = "{kind}"
    speed: float = 1.0
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package to put modules into; returns a function that writes them and names it."""
    name = f"plugins_{tmp_path.name}"
    folder = tmp_path / name
    folder.mkdir()
    monkeypatch.syspath_prepend(tmp_path)

    def write(**modules):
        kinds = {kind: f"{name}.{kind}" for kind in modules}
        (folder / "__init__.py").write_text(f"KINDS = {kinds}\n", "utf-8")
        for module, content in modules.items():
            (folder / f"{module}.py").write_text(content, "utf-8")
        return name

    yield write
    for module in [m for m in sys.modules if m.partition(".")[0] == name]:
        del sys.modules[module]


def section(name, table, **context):
    """A table read as one of the kinds of the package `name`."""
    model = create_model("Deployment", __base__=Settings, part=(kind_union(name), ...))
    return model.model_validate({"part": table}, context=context).part


def test_a_kind_is_imported_when_it_is_named(package):
    name = package(pigeon=MODULE.format(kind="pigeon"), wire=MODULE.format(kind="wire"))
    assert list(variants(name)) == ["pigeon", "wire"]
    assert f"{name}.pigeon" not in sys.modules
    assert section(name, {"kind": "wire", "speed": 2.0}).speed == 2.0
    assert f"{name}.pigeon" not in sys.modules
    assert variants(name)["pigeon"].__name__ == f"{name}.pigeon"


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        ("import no_such_module", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("def f(:", "SyntaxError: invalid syntax"),
        ("undefined", "NameError: name 'undefined' is not defined"),
    ],
)
def test_a_module_that_cannot_be_imported_is_named_with_its_cause_where_its_kind_is(package, content, cause):
    name = package(broken=content, wire=MODULE.format(kind="wire"))
    assert section(name, {"kind": "wire"}).kind == "wire"
    with pytest.raises(ConfigurationError) as refused:
        section(name, {"kind": "broken"})
    assert "the kind 'broken' cannot be loaded" in str(refused.value)
    assert f"{name}/broken.py: {cause}" in str(refused.value)


@pytest.mark.parametrize("table", [{"kind": "pigeon"}, {"kind": 3}, {"kind": []}, {}])
def test_a_kind_that_is_none_is_told_with_those_that_are(package, table):
    name = package(wire=MODULE.format(kind="wire"))
    with pytest.raises(ValidationError) as refused:
        section(name, table)
    (error,) = refused.value.errors()
    assert (error["type"], error["loc"]) == ("union_tag_invalid", ("part",))
    assert error["ctx"]["expected_tags"] == "'wire'"


def test_what_is_wrong_within_a_table_is_told_with_its_key(package):
    name = package(wire=MODULE.format(kind="wire"))
    with pytest.raises(ValidationError) as refused:
        section(name, {"kind": "wire", "speed": "high", "colour": 1})
    assert [error["loc"] for error in refused.value.errors()] == [("part", "speed"), ("part", "colour")]
    with pytest.raises(ValidationError, match="part"):
        section(name, 3)


def test_a_section_that_a_process_does_not_read_is_kept_as_it_is_and_loads_nothing(package):
    name = package(broken="import no_such_module")
    kept = section(name, {"kind": "broken", "speed": 2.0}, unread={name})
    assert isinstance(kept, UnreadSection)
    assert kept.model_dump() == {"kind": "broken", "speed": 2.0}


def test_the_kinds_of_a_section_are_its_parts(package):
    name = package(wire=MODULE.format(kind="wire"))
    assert union_members(kind_union(name)) == (variants(name)["wire"].Config,)
    assert union_members(int | None) == (int, type(None))


@pytest.mark.parametrize("package", PACKAGES)
def test_the_table_of_a_package_names_each_module_that_declares_a_config_by_its_kind(package):
    root = importlib.import_module(f"runtime.{package}")
    names = [f"runtime.{package}.{info.name}" for info in pkgutil.iter_modules(root.__path__)]
    modules = {name: importlib.import_module(name) for name in names}
    declared = {
        module.Config.model_fields["kind"].default: name
        for name, module in modules.items()
        if hasattr(module, "Config")
    }
    assert declared == root.KINDS
