"""Git revision of the source that is running."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType

from runtime import __file__ as _here

_PATIENCE_S = 5.0
_CODE = ("runtime/", "robots/", "deployments/")  # an untracked file there changes what runs


@cache  # cache: of what runs here, which is what was loaded at the start
def revision() -> Mapping[str, object]:
    """Return `commit` and `dirty` of our own checkout, determined once; {} without a checkout or if git fails."""
    return MappingProxyType(revision_of(Path(_here).resolve().parent.parent))


def revision_of(root: Path) -> dict[str, object]:
    """Return `commit` and `dirty` of the checkout with top folder `root`; {} if there is none or git fails.

    Dirty: a tracked file differs from the commit, or runtime/, robots/ or deployments/ has an untracked file.
    """
    top, commit = _git(root, "rev-parse", "--show-toplevel"), _git(root, "rev-parse", "HEAD")
    changes = _git(root, "status", "--porcelain")
    if not top or not commit or changes is None or Path(top).resolve() != root.resolve():
        return {}  # also if the package is installed inside another project's checkout
    return {"commit": commit, "dirty": any(_counts(line) for line in changes.splitlines())}


def _counts(line: str) -> bool:
    status, name = line[:2], line[3:].strip('"')
    return status != "??" or name.startswith(_CODE)


def _git(root: Path, *arguments: str) -> str | None:
    """Return the output of a git command, None if it fails.

    The command writes nothing and ignores the GIT_ variables of a hook.
    """
    plain = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    try:
        completed = subprocess.run(
            # The runtime may run as another user (root, for its scheduling class) than the owner of the
            # checkout.
            ("git", "-c", f"safe.directory={root}", "-C", str(root), *arguments),
            capture_output=True,
            text=True,
            timeout=_PATIENCE_S,
            env=plain | {"GIT_OPTIONAL_LOCKS": "0"},
            check=True,
        )
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return None
    return completed.stdout.rstrip("\n")
