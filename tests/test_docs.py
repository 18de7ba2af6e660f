"""What the documents name is there: commands, modules, files, settings, keys."""

import importlib.util
import re
from functools import cache
from pathlib import Path

import pytest
from django.core.management import get_commands, load_command_class

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
NAMES = [str(document.relative_to(ROOT)) for document in DOCUMENTS]


@cache
def text(name):
    return (ROOT / name).read_text("utf-8")


def everywhere(pattern):
    """(document, what the pattern found) for every match in every document."""
    return [(name, found) for name in NAMES for found in re.findall(pattern, text(name))]


def anchors(name):
    """The anchors of a document's headings, as a forge makes them."""
    heads = re.findall(r"^#+ (.+)$", text(name), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def test_there_is_a_document_for_every_reader():
    assert {"README.md", "CHANGELOG.md"} < set(NAMES)
    for reader in (
        "operator",
        "operating",
        "administrator",
        "api",
        "configuration",
        "episodes",
        "robots",
        "contributing",
    ):
        assert f"(docs/{reader}.md)" in text("README.md"), reader


@pytest.mark.parametrize("name", NAMES)
def test_relative_links_lead_somewhere(name):
    for target in re.findall(r"\]\(([^)\s]+)\)", text(name)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (ROOT / name).parent / path if path else ROOT / name
        assert file.exists(), f"{name} links to {target}"
        if anchor:
            assert anchor in anchors(str(file.resolve().relative_to(ROOT))), f"{name} links to {target}"


def test_every_command_of_manage_py_is_one():
    named = everywhere(r"manage\.py ([a-z][a-z_]+)")
    known = get_commands()
    assert len(named) > 10
    assert [found for found in named if found[1] not in known] == []


def test_every_command_of_ours_is_in_a_document():
    ours = {name for name, app in get_commands().items() if app.startswith("evaweb.")}
    assert (
        ours
        - {found for _, found in everywhere(r"manage\.py ([a-z_]+)|make (demo|lab)\b") for found in found}
        == set()
    )


def test_every_option_of_the_lab_that_a_document_names_is_one():
    for command, uses in (("demo", r"make demo ARGS=\"([^\"]+)\""), ("lab", r"make lab ARGS=\"([^\"]+)\"")):
        parser = load_command_class("evaweb.lab", command).create_parser("manage.py", command)
        known = {option for action in parser._actions for option in action.option_strings}
        options = {word for _, use in everywhere(uses) for word in use.split() if word.startswith("--")}
        assert options <= known, command


def test_every_module_that_a_document_runs_can_be_run():
    named = {found for _, found in everywhere(r"python -m ([a-z0-9_.]+[a-z0-9_])")} - {"pip"}
    assert {"runtime", "runtime.ctl", "runtime.datasets", "robots", "benchmarks"} < named
    for module in sorted(named):
        found = importlib.util.find_spec(module)
        assert found, module
        runs = (
            Path(found.origin).with_name("__main__.py")
            if found.submodule_search_locations
            else Path(found.origin)
        )
        assert runs.is_file(), module
        assert "__main__" in (runs.name + runs.read_text("utf-8")), module


def test_every_robot_that_comes_along_is_pictured_and_told_of():
    folders = sorted(file.parent.name for file in (ROOT / "robots").glob("*/robot.toml"))
    assert len(folders) >= 6
    for name in folders:
        for shown in (f"(robots/{name}.png)", f"| `{name}`: ", f"(../robots/{name}/README.md)"):
            assert shown in text("docs/robots.md"), shown


def test_every_target_of_make_is_one():
    targets = set(re.findall(r"^([a-z][a-z-]*):", text("Makefile"), re.MULTILINE))
    named = everywhere(r"(?:^|`|\n)(?:EVA_\w+=\S+ )*make ([a-z][a-z-]*)")
    assert len(named) > 5
    assert [found for found in named if found[1] not in targets] == []


def test_every_setting_from_the_environment_is_documented_and_every_documented_one_is_read():
    sources = [path for part in ("evaweb", "runtime", "robots") for path in (ROOT / part).rglob("*.py")]
    code = "\n".join(path.read_text("utf-8") for path in sources)
    read = set(re.findall(r"[\"'](EVA_[A-Z_]+|DATABASE_URL|REDIS_URL)[\"']", code))
    table = set(re.findall(r"^\| `([A-Z_]+)` \|", text("docs/administrator.md"), re.MULTILINE))
    assert len(read) > 10
    assert read == table


def cap(key):
    """A key of a page as it stands on a keyboard, and as pages show it."""
    drawn = {
        "Arrowleft": "←",
        "Arrowright": "→",
        "Arrowup": "↑",
        "Arrowdown": "↓",
        "Pageup": "PgUp",
        "Pagedown": "PgDn",
    }
    parts = [part.capitalize() for part in key.split("+")]
    return "+".join(drawn.get(part, part) for part in parts).replace("Shift+", "⇧")


def test_every_key_of_a_page_is_in_the_operators_document():
    pages = "\n".join(path.read_text("utf-8") for path in (ROOT / "templates").rglob("*.html"))
    caps = {cap(key) for key in re.findall(r'data-key="([^"{]+)"', pages)}
    keys = text("docs/operator.md").partition("## Keys")[2].partition("\n## ")[0]
    documented = set(re.findall(r"`([^`]+)`", keys))
    for first, last in re.findall(r"`(\d)` to `(\d)`", keys):
        documented |= {str(number) for number in range(int(first), int(last))}
    assert len(caps) > 10
    assert caps - documented == set()


def test_every_address_of_the_interface_is_in_its_document():
    described = set(re.findall(r'"(/api/v1/[^"]*)": \{', text("docs/openapi.json")))
    parameters = {
        f"{{{name}}}": name.upper() for name in ("name", "id", "uuid", "version", "checkpoint", "digest")
    }
    for address in described:
        shown = address
        for given, word in parameters.items():
            shown = shown.replace(given, word)
        known = (shown, shown.removesuffix("/NAME"))  # one of a list of which the document shows the list
        assert any(f"`{one}`" in text("docs/api.md") or f" {one}`" in text("docs/api.md") for one in known), (
            address
        )


def test_no_document_names_what_is_of_one_place_only():
    made_up = ("127.0.0.1", "localhost", "host", "lab.example.org", "10.0.0.7", "gpu-3")
    for name in NAMES:
        named = set(
            re.findall(
                r"(?:https?|wss?|postgres|redis)://(?:[^/\s@`]+@)?([A-Za-z0-9][A-Za-z0-9.-]*)", text(name)
            )
        )
        assert not {host for host in named if host not in made_up}, name
        homes = re.findall(r"(?<![\w.])/(?:home|root|tmp)/", text(name))
        assert not homes, name
