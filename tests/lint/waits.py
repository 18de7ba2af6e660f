"""Refuses waits with a number of their own: `python -m tests.lint.waits`, called by `make lint`.

What a test waits for has PATIENCE_S (or PATIENCE_MS) of tests/processes.py, which a slow machine can lengthen. A
shorter number is the length of a turn, or of a silence that is wanted; one that is longer decides whether a right
product passes.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

TESTS = Path(__file__).parents[1]
LONGEST_S = 4.0  # of a turn, or of a silence
_SECONDS = {  # calls that wait, and where their seconds may stand
    "acquire": 1,
    "connect": None,
    "communicate": None,
    "create_connection": 1,
    "eventually": 2,
    "join": 0,
    "receive_output": 0,
    "recv": None,
    "result": 0,
    "run": None,
    "select": 3,
    "settimeout": 0,
    "sleep": 0,
    "urlopen": None,
    "wait": 1,
    "wait_for": 1,
    "HTTPConnection": None,
    "HTTPSConnection": None,
}
_MILLISECONDS = {"poll": 0, "set_default_timeout": 0, "wait_for_selector": None, "wait_for_timeout": 0}
_WORDS = ("timeout", "seconds", "patience")


def waits(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and sentence of each wait that has a number of its own."""
    known = {
        target.id: statement.value.value
        for statement in tree.body
        if isinstance(statement, ast.Assign) and isinstance(statement.value, ast.Constant)
        for target in statement.targets
        if isinstance(target, ast.Name)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp) and ast.unparse(node.left) == "time.monotonic()":
            number = node.right.value if isinstance(node.right, ast.Constant) else 0.0
            if isinstance(node.op, ast.Add) and isinstance(number, (int, float)) and number > LONGEST_S:
                yield node.lineno, f"a deadline of {number:g} s; allowed: PATIENCE_S"
        if not isinstance(node, ast.Call):
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name == "timeout" and isinstance(node.func, ast.Attribute):
            yield node.lineno, "pytest.mark.timeout: allowed: the one of pyproject.toml"
        for table, unit, word in ((_SECONDS, 1.0, "PATIENCE_S"), (_MILLISECONDS, 1000.0, "PATIENCE_MS")):
            if name not in table:
                continue
            given = [keyword.value for keyword in node.keywords if keyword.arg in _WORDS]
            place = table[name]
            given += [] if place is None else _unpacked(node.args)[: place + 1]
            for value in given:
                number = (
                    value.value if isinstance(value, ast.Constant) else known.get(getattr(value, "id", ""))
                )
                if isinstance(number, (int, float)) and not isinstance(number, bool):
                    playwright = name == "wait_for" and number > 1000
                    if number > LONGEST_S * (1000.0 if playwright else unit):
                        yield (
                            node.lineno,
                            f"{name} waits {number:g}; allowed: {word}, a turn of {LONGEST_S:g} s",
                        )


def _unpacked(arguments: Sequence[ast.expr]) -> list[ast.expr]:
    """Arguments of a call, those of `*(...)` one by one."""
    return [
        part
        for one in arguments
        for part in (
            one.value.elts if isinstance(one, ast.Starred) and isinstance(one.value, ast.Tuple) else [one]
        )
    ]


def main() -> int:
    """Print what is refused; 1 where there is any."""
    found = [
        f"{path.relative_to(TESTS.parent)}:{line}: {sentence}"
        for path in sorted(TESTS.rglob("*.py"))
        for line, sentence in waits(ast.parse(path.read_text("utf-8")))
    ]
    print("\n".join(found) or "every wait of the tests has the patience of all")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
