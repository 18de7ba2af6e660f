"""Sidecar files of an episode in its dataset, provided by apps of higher layers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from uuid import UUID

SidecarWriter = Callable[[UUID, Path], Mapping[str, Path]]

_givers: list[SidecarWriter] = []


def register_sidecar_writer(function: SidecarWriter) -> SidecarWriter:
    """Register a function that writes sidecar files and returns them by kind.

    Apps of higher layers call this when Django starts (`AppConfig.ready`). The registered function gets the episode's
    uuid and a folder of its own, and writes JSON Lines there.
    """
    if function not in _givers:
        _givers.append(function)
    return function


def write_sidecars(uuid: UUID, folder: Path) -> dict[str, Path]:
    """Write the sidecar files of the episode to `folder`; return them by kind."""
    return {kind: path for give in _givers for kind, path in give(uuid, folder).items()}
