"""Refuses waits with a number of their own: `python -m tests.lint.waits`, called by `make lint`.

What a test waits for has PATIENCE_S (or PATIENCE_MS) of tests/processes.py, which a slow machine can lengthen. A
shorter number is the length of a turn, or of a silence that is wanted; one that is longer decides whether a right
product passes.
"""

from __future__ import annotations

import ast
import operator
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
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
_WORDS = ("timeout", "seconds", "patience")  # the first in whatever is called
_MADE: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
}


def waits(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and sentence of each wait that has a number of its own."""
    known: dict[str, float] = {}
    for statement in tree.body:
        if isinstance(statement, ast.Assign) and (number := _number(statement.value, known)) is not None:
            known |= {target.id: number for target in statement.targets if isinstance(target, ast.Name)}
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp) and ast.unparse(node.left) == "time.monotonic()":
            added = _number(node.right, known) or 0.0
            if isinstance(node.op, ast.Add) and added > LONGEST_S:
                yield node.lineno, f"a deadline of {added:g} s; allowed: PATIENCE_S"
        if not isinstance(node, ast.Call):
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name == "timeout" and isinstance(node.func, ast.Attribute):
            yield node.lineno, "pytest.mark.timeout: allowed: the one of pyproject.toml"
        for table, unit, word in ((_SECONDS, 1.0, "PATIENCE_S"), (_MILLISECONDS, 1000.0, "PATIENCE_MS")):
            if name not in table and (table is _MILLISECONDS or name in _MILLISECONDS):
                continue
            words = _WORDS if name in table else _WORDS[:1]
            given = [keyword.value for keyword in node.keywords if keyword.arg in words]
            place = table.get(name)
            given += [] if place is None else _unpacked(node.args)[: place + 1]
            for value in given:
                waited = _number(value, known) or 0.0
                playwright = name == "wait_for" and waited > 1000
                if waited > LONGEST_S * (1000.0 if playwright else unit):
                    yield (
                        node.lineno,
                        f"{name} waits {waited:g}; allowed: {word}, a turn of {LONGEST_S:g} s",
                    )


def _number(value: ast.expr, known: Mapping[str, float]) -> float | None:
    """Of a constant, a name of this module that is one, and what is made of them; None of anything else."""
    if isinstance(value, ast.Constant):
        return value.value if isinstance(value.value, (int, float)) else None
    if isinstance(value, ast.Name):
        return known.get(value.id)
    if isinstance(value, ast.BinOp) and type(value.op) in _MADE:
        left, right = _number(value.left, known), _number(value.right, known)
        return None if left is None or right is None else _MADE[type(value.op)](left, right)
    return None


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
