"""What imports what, read off the source: nothing is imported to find out."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
Import = ast.Import | ast.ImportFrom


class Sources:
    """The modules below some top-level packages in `root`, by their full names."""

    def __init__(self, *packages: str, root: Path = ROOT) -> None:
        self.paths = {
            _module_name(path, root): path for package in packages for path in (root / package).rglob("*.py")
        }
        self.imports = cache(self.imports)  # type: ignore[method-assign]

    def imports(self, module: str, everywhere: bool = False) -> frozenset[str]:
        """Full names that `module` imports when it is itself imported, or anywhere at all."""
        tree = ast.parse(self.paths[module].read_text("utf-8"))
        return frozenset(
            name for node in _walk(tree.body, everywhere) for name in self._imported(node, module)
        )

    def inside(self, module: str, everywhere: bool = False) -> set[str]:
        """The modules of ours among them."""
        return {name for name in self.imports(module, everywhere) if name in self.paths and name != module}

    def circle(self) -> list[str]:
        """Modules that import each other in a circle when they are imported; [] where there are none."""
        graph = {module: self.inside(module) for module in self.paths}
        try:
            order = list(TopologicalSorter(graph).static_order())
        except CycleError as error:
            return list(error.args[1])
        assert len(order) == len(self.paths)
        return []

    def _imported(self, node: Import, module: str) -> list[str]:
        if isinstance(node, ast.Import):
            return [alias.name for alias in node.names]
        is_package = self.paths[module].name == "__init__.py"
        package = module if is_package else module.rpartition(".")[0]
        base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
        origin = ".".join([*base, *([node.module] if node.module else [])])
        names = [f"{origin}.{alias.name}" for alias in node.names]
        # What is taken from a package is a module of it, or else a name that its __init__ must have made by then.
        return names if all(name in self.paths for name in names) else [origin, *names]


def _module_name(path: Path, root: Path) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


def _walk(nodes: Iterable[ast.AST], everywhere: bool) -> Iterator[Import]:
    for node in nodes:
        if _is_type_checking(node):
            yield from _walk(node.orelse, everywhere)  # type: ignore[attr-defined]
        elif isinstance(node, Import):
            yield node
        elif everywhere or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from _walk(ast.iter_child_nodes(node), everywhere)
