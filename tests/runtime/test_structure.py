"""What no linter of imports sees."""

import ast
import re

import pytest

from tests.sources import ROOT

MAKES = re.compile("dict|list|set|deque|defaultdict|Counter|OrderedDict|count|Lock|RLock|local")
MUTATES = re.compile("append(left)?|extend|insert|add|update|setdefault|pop(item|left)?|remove|discard|clear")
NAMED = re.compile(r"# (cache|state): \w")


def test_nothing_in_the_runtime_names_a_robot():
    robots = [path.parent.name for path in (ROOT / "robots").glob("*/robot.toml")]
    names = {name for robot in robots for name in (robot, robot.replace("_", "-"), robot.replace("_", " "))}
    pattern = re.compile("|".join(map(re.escape, sorted(names))), re.IGNORECASE)
    files = sorted((ROOT / "runtime").rglob("*.py"))
    assert len(robots) == 7
    assert len(files) > 400
    assert {
        str(path.relative_to(ROOT)): found
        for path in files
        if (found := pattern.findall(path.read_text("utf-8")))
    } == {}


def called(node):
    """The last part of the name of what is called, or decorates."""
    node = node.func if isinstance(node, ast.Call) else node
    return getattr(node, "attr", getattr(node, "id", ""))


def made(tree):
    """Statements that give a module what can change."""
    classes = [c for c in tree.body if isinstance(c, ast.ClassDef)]
    own = {c.name for c in classes if any(getattr(part, "name", "") == "__init__" for part in c.body)}
    for statement in tree.body:
        value = getattr(statement, "value", None)
        if isinstance(statement, ast.Assign | ast.AnnAssign) and value is not None:
            empty = isinstance(value, ast.Dict | ast.List) and len(ast.unparse(value)) == 2
            call = isinstance(value, ast.Call) and (MAKES.fullmatch(called(value)) or called(value) in own)
            if empty or call:
                yield statement


def changed(tree):
    """Nodes that keep something in a module, or change what it has."""
    assigned = [n for n in tree.body if isinstance(n, ast.Assign | ast.AnnAssign)]
    names = {getattr(t, "id", "") for n in assigned for t in getattr(n, "targets", None) or [n.target]} - {""}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            yield from (d for d in node.decorator_list if called(d) in ("cache", "lru_cache"))
        told = isinstance(node, ast.Call) and MUTATES.fullmatch(called(node))
        stored = isinstance(node, ast.Subscript) and not isinstance(node.ctx, ast.Load)
        holder = getattr(node.func if told else node, "value", None)
        if isinstance(node, ast.Global) or ((told or stored) and getattr(holder, "id", None) in names):
            yield node


def stateful(source):
    """Lines of a module on which state of the module is made or changed, and not named."""
    tree, lines = ast.parse(source), source.splitlines()
    found = {lines[node.lineno - 1].strip() for node in (*made(tree), *changed(tree))}
    return sorted(line for line in found if not NAMED.search(line))


def test_a_module_of_the_runtime_keeps_nothing_but_caches_and_what_says_why():
    """`# cache:` or `# state:` and the reason, on the line; two stations in one process are apart."""
    files = sorted((ROOT / "runtime").rglob("*.py"))
    assert {
        str(path.relative_to(ROOT)): found for path in files if (found := stateful(path.read_text("utf-8")))
    } == {}


@pytest.mark.parametrize(
    "line",
    [
        "SEEN = []",
        "SEEN: dict[str, int] = {}",
        "NUMBERS = itertools.count()",
        "LOCK = threading.Lock()",
        "class Seen:\n    def __init__(self): ...\nSEEN = Seen()",
        "@functools.cache\ndef made(): ...",
        "@lru_cache(maxsize=8)\ndef made(): ...",
        "def note():\n    global number",
        "SEEN = {1: 2}\ndef note(): SEEN[1] = 3",
        "SEEN = [1]\ndef note(): SEEN.append(3)",
    ],
)
def test_state_of_a_module_is_noticed(line):
    assert stateful(line)
    assert not stateful("\n".join(f"{part}  # cache: a reason" for part in line.splitlines()))
