"""Repair of episodes that the previous start of a station left open."""

from __future__ import annotations

import json
import logging
import os
import threading
from collections.abc import Callable
from pathlib import Path

from runtime.core.errors import RecordingError
from runtime.recording.repair import repair

log = logging.getLogger(__name__)


def start_repair(root: Path, station: str, repaired: Callable[[Path], None]) -> None:
    """Start the repair on a thread, so that new observations and recordings do not wait for it."""
    arguments = (find_open_episodes(root), station, repaired)
    threading.Thread(target=repair_open_episodes, args=arguments, name="repair", daemon=True).start()


def find_open_episodes(root: Path) -> list[Path]:
    """Return the folders of episodes without an outcome. Call it before the first new episode begins."""
    folders = [manifest.parent for manifest in root.glob("*/manifest.json")]
    return [folder for folder in folders if not os.path.exists(folder / "outcome.json")]


def repair_open_episodes(
    folders: list[Path], station: str, repaired: Callable[[Path], None] = lambda folder: None
) -> None:
    """Repair the episodes that the previous start of `station` left open; no other process writes them.

    `repaired` is called with each folder that is complete again. An episode that cannot be repaired is left as it is,
    for `python -m runtime.recording repair` and a person.
    """
    for folder in folders:
        if _station_of(folder / "manifest.json") != station:
            continue
        try:
            report = repair(folder)
            finding = report.problem or f"{report.frames} rows"
            log.warning("episode %s was left open: %s, %s", folder.name, report.verdict, finding)
            if report.verdict in ("repaired", "restored", "complete"):
                repaired(folder)
        except RecordingError as error:
            log.error("episode %s was left open and stays as it is: %s", folder.name, error)
        except Exception:  # an unforeseen file must not prevent the repair of the others
            log.exception("episode %s was left open and stays as it is", folder.name)


def _station_of(manifest: Path) -> str:
    try:
        return str(json.loads(manifest.read_text("utf-8"))["station"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.error("%s cannot be read (%r): left as it is", manifest, error)
        return ""
