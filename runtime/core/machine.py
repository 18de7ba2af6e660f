"""What of this machine affects computed results: its processor, and the versions of libraries."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path

_CPUINFO = Path("/proc/cpuinfo")
_COMPUTING = ("sse", "ssse", "avx", "fma", "f16c", "bmi", "amx", "asimd", "sve", "neon", "fp")
_DIGITS = 8
_PACKAGES = ("eva-web", "numpy", "numba", "mujoco-core", "pyarrow", "av", "pyzmq", "msgpack")


def installed_versions() -> dict[str, str]:
    """Return the versions of Python, of this package, and of libraries that affect runs or recordings."""
    return {"python": platform.python_version()} | {package: version(package) for package in _PACKAGES}


@cache  # cache: a processor does not change
def processor() -> dict[str, str]:
    """Return `architecture`, `model` and `features` of this machine's processor, which manifests have.

    `features` are those that libraries choose their code by, such as avx2. On other processors the same computation may
    differ in its last bits.
    """
    rows: dict[str, str] = {}
    if _CPUINFO.exists():
        for line in _CPUINFO.read_text("utf-8", "replace").splitlines():
            name, _, value = line.partition(":")
            rows.setdefault(name.strip(), value.strip())
    features = {
        flag for flag in rows.get("flags", rows.get("Features", "")).split() if flag.startswith(_COMPUTING)
    }
    return {
        "architecture": platform.machine(),
        "model": rows.get("model name", ""),
        "features": " ".join(sorted(features)),
    }


def machine_kind() -> str:
    """Return a short name of processor and versions of libraries: equal where a computation has the same bits."""
    own, versions = processor(), installed_versions()
    parts = (own["architecture"], own["features"], *(f"{name} {versions[name]}" for name in sorted(versions)))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:_DIGITS]
