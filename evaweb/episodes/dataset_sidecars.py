"""Side files of an episode for its dataset; apps above this one have them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from uuid import UUID

SidecarWriter = Callable[[UUID, Path], Mapping[str, Path]]

_givers: list[SidecarWriter] = []


def register_sidecar_writer(function: SidecarWriter) -> SidecarWriter:
    """Declare what goes beside a published episode, by kind of side file: an app above this one, from its `ready`.

    It is given the episode and a folder of its own, and writes JSON Lines there.
    """
    if function not in _givers:
        _givers.append(function)
    return function


def write_sidecars(uuid: UUID, folder: Path) -> dict[str, Path]:
    """Side files of the episode, written into `folder`."""
    return {kind: path for give in _givers for kind, path in give(uuid, folder).items()}
