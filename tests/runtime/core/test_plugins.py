import sys

import pytest

from runtime.core.errors import ConfigurationError
from runtime.core.plugins import variants

MODULE = """
from typing import Literal
from runtime.core.settings import Settings

class Config(Settings):
    kind: Literal["{kind}"] = "{kind}"
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package to put modules into; returns a function that writes one."""
    name = f"plugins_{tmp_path.name}"
    folder = tmp_path / name
    folder.mkdir()
    (folder / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)

    def write(module, content):
        (folder / f"{module}.py").write_text(content, "utf-8")
        return name

    yield write
    for module in [m for m in sys.modules if m.partition(".")[0] == name]:
        del sys.modules[module]


def test_a_new_file_is_a_new_variant_by_its_kind(package):
    package("carrier", MODULE.format(kind="pigeon"))
    name = package("wire", MODULE.format(kind="wire"))
    assert {kind: module.__name__ for kind, module in variants(name).items()} == {
        "pigeon": f"{name}.carrier",
        "wire": f"{name}.wire",
    }


def test_modules_without_a_config_and_private_ones_are_no_variants(package):
    package("base", "class Transport: ...")
    package("_draft", MODULE.format(kind="draft"))
    name = package("wire", MODULE.format(kind="wire"))
    assert list(variants(name)) == ["wire"]


def test_two_modules_of_one_kind_are_an_error_that_names_both(package):
    package("one", MODULE.format(kind="wire"))
    name = package("two", MODULE.format(kind="wire"))
    with pytest.raises(
        ConfigurationError, match=rf"{name}.two declares the kind 'wire', which is {name}.one's"
    ):
        variants(name)


def test_the_runtime_comes_with_these():
    assert set(variants("runtime.transports")) >= {"dataset", "zmq"}
    assert set(variants("runtime.policies")) >= {"mock", "openpi", "replay"}
    assert set(variants("runtime.strategies")) >= {"async", "sync"}
