"""Which attributes of which classes code reads, by the types that mypy finds."""

from __future__ import annotations

import ast
import functools
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

from mypy.build import BuildSource, build
from mypy.config_parser import parse_config_file
from mypy.nodes import MemberExpr, Node, TypeInfo
from mypy.options import Options
from mypy.types import Instance, Type, TypeVarType, UnionType, get_proper_type

Reads = dict[tuple[str, str], set[str]]
"""By the class that declares it and its name, the modules that read an attribute."""
_REFERENCES = {"node", "info", "type", "names", "alias_deps", "plugin_deps"}


def attribute_reads(modules: Mapping[str, Path], root: Path) -> Reads:
    """Every attribute that `modules` (by name) read of a value whose class is known.

    What a validator reads of its own model does not count: to check a key is not to obey it.
    """
    options = Options()
    parse_config_file(options, lambda: None, str(root / "pyproject.toml"))
    options.incremental, options.export_types, options.preserve_asts = False, True, True
    # What others wrote is most of the work. Where their types are unknown a read may be missed, never invented.
    options.follow_imports, options.per_module_options["numpy.*"] = "skip", {"follow_imports": "normal"}
    built = build([BuildSource(str(path), name, None) for name, path in modules.items()], options)
    reads: Reads = defaultdict(set)
    for name, path in modules.items():
        checked = _checked(path)
        for given in _members(built.files[name]):
            if given.line not in checked:
                for owner in _owners(built.types.get(given.expr), given.name):
                    reads[owner, given.name].add(name)
    return reads


def _members(of: Node) -> Iterator[MemberExpr]:
    """Every `value.attribute` below a node. mypy's own visitors are compiled and cannot be extended."""
    left, seen = [of], set()
    while left:
        given = left.pop()
        if id(given) in seen:
            continue
        seen.add(id(given))
        if isinstance(given, MemberExpr):
            yield given
        kind: type = type(given)  # mypy takes a type[Node] for unhashable
        for attribute in _attributes(kind):
            left.extend(_nodes(getattr(given, attribute, None)))


@functools.cache
def _attributes(kind: type) -> tuple[str, ...]:
    """Where nodes of that kind have what is written below them; not what their names refer to."""
    named = {name for base in kind.__mro__ for name in getattr(base, "__mypyc_attrs__", ())}
    return tuple(sorted(named - _REFERENCES))


def _nodes(value: object) -> Iterator[Node]:
    if isinstance(value, Node) and not isinstance(value, TypeInfo):
        yield value
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _nodes(part)


def _owners(of: Type | None, attribute: str) -> Iterator[str]:
    """The classes that declare the attribute of a value of that type."""
    found = get_proper_type(of) if of is not None else None
    if isinstance(found, Instance):
        info = getattr(getattr(found.type.get(attribute), "node", None), "info", None)
        if info:
            yield info.fullname
    elif isinstance(found, UnionType):
        for part in found.items:
            yield from _owners(part, attribute)
    elif isinstance(found, TypeVarType):
        yield from _owners(found.upper_bound, attribute)


def _checked(path: Path) -> set[int]:
    """The lines of pydantic's validators."""
    lines: set[int] = set()
    for given in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(given, ast.FunctionDef) and any(
            "validator" in ast.unparse(decorator) for decorator in given.decorator_list
        ):
            lines.update(range(given.lineno, (given.end_lineno or given.lineno) + 1))
    return lines
