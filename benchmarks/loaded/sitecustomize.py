"""On PYTHONPATH: each process writes its loaded modules at its end, to one file per program in $EVA_LOADED.

Only for benchmarks.start and tests. Modules listed in EVA_BROKEN, separated by commas, cannot be imported.
"""

import atexit
import os
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType


class _Broken(MetaPathFinder):
    """Import finder that refuses the modules with these names."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name in self._names:
            raise ImportError("broken on purpose")
        return None


def _write() -> None:
    program = getattr(sys.modules["__main__"], "__spec__", None)
    if program is not None:
        with open(os.path.join(os.environ["EVA_LOADED"], program.name), "w") as file:
            file.write("\n".join(sorted(sys.modules)))


atexit.register(_write)
if broken := os.environ.get("EVA_BROKEN"):
    sys.meta_path.insert(0, _Broken(broken.split(",")))
