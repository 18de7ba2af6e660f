"""Names of functions and classes that use a word which says nothing to a reader from the field.

The words are those of docs/glossary.md's last section. A name that uses one in its field's sense is in `avoided.txt`,
as `module qualified.name`; that list may only become shorter.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
ALLOWED = Path(__file__).with_name("avoided.txt")
PACKAGES = ("runtime", "robots", "evaweb", "benchmarks")
_WORDS = """
aside ask asked asks beside doubt escort eyes found give given gives hear heard hears held keep keeps kept lay lie lies
look looks luck made meant nobody one ones other others rest said say says see seen sees sight stand take taken takes
tell tells told trouble way whoever whose word words
"""
AVOIDED = frozenset(_WORDS.split())


def parts_of(name: str) -> list[str]:
    """Return the words of a name in snake or camel case."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().strip("_").split("_")


def definitions(tree: ast.AST, above: str = "") -> Iterator[str]:
    """Yield the qualified names of all classes, functions and methods."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield f"{above}{node.name}"
            yield from definitions(node, f"{above}{node.name}.")
        else:
            yield from definitions(node, above)


def avoided_names(root: Path = ROOT) -> set[str]:
    """Return `module qualified.name` of every definition that has an avoided word."""
    found = set()
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            if path.parent.name == "migrations":
                continue
            module = ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
            names = definitions(ast.parse(path.read_text("utf-8")))
            found |= {
                f"{module} {name}" for name in names if AVOIDED.intersection(parts_of(name.split(".")[-1]))
            }
    return found


def problems(found: set[str], allowed: set[str]) -> Iterator[str]:
    """Yield a sentence for each name that is new, and for each that the list has for nothing."""
    for name in sorted(found - allowed):
        words = ", ".join(sorted(AVOIDED.intersection(parts_of(name.split(".")[-1].split(" ")[-1]))))
        yield f"{name}: {words}: use the field's word (docs/glossary.md)"
    for name in sorted(allowed - found):
        yield f"{name}: no such definition; remove it from {ALLOWED.relative_to(ROOT)}"
