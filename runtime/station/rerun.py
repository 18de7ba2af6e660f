"""New start of the deployment of an earlier run, from its manifest, with a report of the differences."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from runtime.config.loader import Resolved, apply_assignments, config_digest
from runtime.config.schema import REMOVED_BUS_KEYS
from runtime.core.errors import ConfigurationError, RecordingError
from runtime.core.git_revision import revision
from runtime.core.machine import installed_versions
from runtime.recording.files import read_json

_LISTED = 8  # most runs or keys in a sentence
_SHORT = 12  # characters of a hash that are shown
_UNKNOWN = "unknown"
_DIRTY = " with changes"
_ABSENT = object()


@dataclass(frozen=True, slots=True)
class Rerun:
    """Deployment of an earlier run, with lines about that run and each difference."""

    resolved: Resolved
    lines: tuple[str, ...]


def rerun(run: str, data: Path, assignments: Sequence[str] = ()) -> Rerun:
    """Return the deployment of the run in `data` whose uuid begins with `run`, changed by `key=value` assignments.

    It includes the options of that run (mode, simulated state, duration). New recordings go to `data`. Raises
    ConfigurationError if something is missing, was changed since, or is no longer a setting.
    """
    folder = find_episode(run, data)
    try:
        manifest = read_json(folder / "manifest.json")
    except RecordingError as error:
        raise ConfigurationError(str(error)) from None
    stored = _configuration(folder, manifest)
    source = f"the configuration of run {folder.name}"
    requested = _requested_settings(deepcopy(stored), manifest, data)
    resolved = apply_assignments(requested, {}, source, assignments)
    return Rerun(resolved, tuple(_lines(folder.name, manifest, stored, resolved)))


def find_episode(run: str, data: Path) -> Path:
    """Return the folder of the only episode in `data` whose uuid begins with `run`.

    Raises ConfigurationError if there is none or several.
    """
    episodes = data / "episodes"
    prefix = run.strip().lower()
    if not prefix or not set(prefix) <= set("0123456789abcdef-"):
        raise ConfigurationError(f"--from-run {run!r}: must be the uuid of a run, or how it begins")
    if not episodes.is_dir():
        raise ConfigurationError(
            f"--from-run {run}: there are no episodes in {data}; name the data folder with --data-dir"
        )
    matches = sorted(path.name for path in episodes.glob(f"{prefix}*") if path.is_dir())
    if not matches:
        raise ConfigurationError(
            f"--from-run {run}: no episode in {episodes} begins so; name another data folder with --data-dir"
        )
    if len(matches) > 1 and prefix not in matches:
        named = ", ".join(matches[:_LISTED]) + (", ..." if len(matches) > _LISTED else "")
        raise ConfigurationError(f"--from-run {run}: {len(matches)} episodes begin so: {named}")
    return episodes / (prefix if prefix in matches else matches[0])


def _configuration(folder: Path, manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return the stored configuration after comparing it with its hash."""
    path = folder / "manifest.json"
    stored, digest = manifest.get("configuration"), manifest.get("configuration_hash")
    if not isinstance(stored, dict) or not stored:
        raise ConfigurationError(f"{path} has no configuration: that run cannot be started again")
    if not isinstance(digest, str) or not digest:
        raise ConfigurationError(f"{path} has no configuration_hash: its configuration cannot be verified")
    actual = config_digest(stored)
    if actual != digest:
        raise ConfigurationError(
            f"{path}: configuration has the hash {_short(actual)}, the run was made with {_short(digest)}: "
            "the manifest was altered since"
        )
    return stored


def _requested_settings(tree: dict[str, Any], manifest: Mapping[str, Any], data: Path) -> dict[str, Any]:
    """Return the configuration with the options of the run that the manifest names, and with `data` as data folder.

    The options of an episode of the mode "observe" are not used, because it is not a run.
    """
    run = tree.get("run")
    if isinstance(run, dict) and manifest.get("mode") != "observe":
        for key in ("mode", "sim_state", "duration_s"):
            if key in manifest and key in run:
                run[key] = manifest[key]
    for key in REMOVED_BUS_KEYS:  # it has no effect on what was done
        tree.get("bus", {}).pop(key, None)
    if data_folder(tree.get("data_dir")) != data:
        tree["data_dir"] = str(data)
    return tree


def data_folder(given: str | Path | None = None) -> Path:
    """Return the absolute data folder: `given`, else $EVA_DATA_DIR, else ./data."""
    return Path(given or os.environ.get("EVA_DATA_DIR") or "data").expanduser().absolute()


def _lines(run: str, then: Mapping[str, Any], stored: Mapping[str, Any], now: Resolved) -> list[str]:
    return [
        f"run       {run}, {_described(then)}",
        f"versions  {_versions(then.get('versions'))}",
        f"git       {_revisions(then.get('git'))}",
        f"hash      {_hashes(str(then['configuration_hash']), stored, now)}",
    ]


def _described(manifest: Mapping[str, Any]) -> str:
    requested_wall = manifest.get("asked_wall", manifest.get("started_wall"))
    date = (
        f"{datetime.fromtimestamp(requested_wall):%Y-%m-%d %H:%M}"
        if isinstance(requested_wall, int | float)
        else "no date"
    )
    fields = (f"{key} {manifest[key]}" for key in ("station", "mode", "strategy") if manifest.get(key))
    return ", ".join((date, *fields, f"task {manifest.get('task', '')!r}"))


def _versions(then: object) -> str:
    if not isinstance(then, Mapping) or not then:
        return "of then are not known"
    now = installed_versions()
    differ = [
        f"{name} {then.get(name, 'unknown')} then, {now.get(name, 'none')} now"
        for name in sorted({*then, *now})
        if then.get(name) != now.get(name)
    ]
    return "; ".join(differ) or "the same"


def _revisions(then: object) -> str:
    before, now = _revision(then), _revision(revision())
    certain = before == now and not before.endswith(_DIRTY)
    return f"the same, {now}" if certain and now != _UNKNOWN else f"{before} then, {now} now"


def _revision(value: object) -> str:
    """Return the short form of a revision; a revision with uncommitted changes never counts as equal to another."""
    if not isinstance(value, Mapping) or not value.get("commit"):
        return _UNKNOWN
    return _short(str(value["commit"])) + (_DIRTY if value.get("dirty") else "")


def _hashes(then: str, stored: Mapping[str, Any], now: Resolved) -> str:
    if then == now.digest:
        return f"the same, {_short(then)}"
    before, after = _leaves(stored), _leaves(now.tree)
    differ = [
        f"{key} {_format_value(before, key)} -> {_format_value(after, key)}"
        for key in sorted({*before, *after})
        if before.get(key, _ABSENT) != after.get(key, _ABSENT)
    ]
    named = "; ".join(differ[:_LISTED]) + (f"; {len(differ) - _LISTED} more" if len(differ) > _LISTED else "")
    return f"{_short(then)} then, {_short(now.digest)} now: {named}"


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return every setting of the nested tables by its full key."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            leaves |= _leaves(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = value
    return leaves


def _format_value(leaves: Mapping[str, Any], key: str) -> str:
    return json.dumps(leaves[key]) if key in leaves else "(none)"


def _short(digest: str) -> str:
    return digest[:_SHORT]
