"""Set-ups of sessions: what a station will record next, and the differences from another set-up."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from evaweb.core.errors import Conflict
from runtime.core.sentences import Pattern

_COLLECTS_NOTHING_DEPLOYMENT_HAS_NO = Pattern(
    "collect.setups.collects_nothing_deployment_has_no",
    "{station} collects nothing: its deployment has no [collection]",
)
_HAS_NOT_SEEN_PICTURE_EVERY = Pattern(
    "collect.setups.has_not_seen_picture_every",
    "{station} has no picture yet of these cameras: {cameras}; check those that are grey",
)
_SET_UP_DIFFERS_FROM = Pattern(
    "collect.setups.set_up_differs_from",
    "the set-up differs from that of {whose}: {found}",
)

Setup = Mapping[str, Any]
_PLAIN = ("robot", "groups", "joints", "fps")


class SetupChanged(Conflict):
    """Error if the station's set-up differs from that of the session."""


def setup_from_snapshot(snapshot: Mapping[str, Any], station: str) -> dict[str, Any]:
    """Return the set-up in a station's snapshot.

    Raises: Conflict if the station collects nothing or a camera has not delivered an image yet.
    """
    collect = snapshot.get("collect")
    if collect is None:
        raise Conflict(_COLLECTS_NOTHING_DEPLOYMENT_HAS_NO(station=station))
    if collect.get("setup") is None:
        raise Conflict(_HAS_NOT_SEEN_PICTURE_EVERY(station=station, cameras=", ".join(collect["cameras"])))
    return dict(collect["setup"])


def setup_from_manifest(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return the set-up in an episode's manifest."""
    robot = manifest["robot"]
    return {
        "robot": robot["name"],
        "groups": list(dict.fromkeys(name.partition(".")[0] for name in robot["joint_names"])),
        "joints": list(robot["joint_names"]),
        "cameras": manifest["cameras"],
        "fps": manifest["fps"],
        "streams": manifest["streams"],
    }


def setup_differences(given: Setup, allowed: Setup) -> list[str]:
    """Return a message for each difference of `given` from `allowed`; [] if they are equal."""
    return [
        *_plain(given, allowed),
        *_cameras(given["cameras"], allowed["cameras"]),
        *_streams(given, allowed),
    ]


def require_same_setup(given: Setup, allowed: Setup, whose: str) -> None:
    """Raise SetupChanged with every difference; `whose` names the owner of `allowed`."""
    differences = setup_differences(given, allowed)
    if differences:
        raise SetupChanged(_SET_UP_DIFFERS_FROM(whose=whose, found="; ".join(differences)))


def _plain(setup: Setup, allowed: Setup) -> Iterator[str]:
    for name in _PLAIN:
        if setup[name] != allowed[name]:
            yield f"{name} = {_words(setup[name])}, allowed {_words(allowed[name])}"


def _cameras(sizes: Mapping[str, Any], allowed: Mapping[str, Any]) -> Iterator[str]:
    for key in sorted(sizes.keys() | allowed.keys()):
        if sizes.get(key) != allowed.get(key):
            yield f"camera {key} = {_size(sizes.get(key))}, allowed {_size(allowed.get(key))}"


def _streams(own: Setup, allowed: Setup) -> Iterator[str]:
    recorded = [
        sorted(name for name, is_recorded in setup["streams"].items() if is_recorded)
        for setup in (own, allowed)
    ]
    if recorded[0] != recorded[1]:
        yield f"recorded = {_words(recorded[0])}, allowed {_words(recorded[1])}"


def _words(value: object) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return (", ".join(map(str, value)) or "none") if isinstance(value, list) else str(value)


def _size(size: Mapping[str, Any] | None) -> str:
    return "none" if size is None else f"{size['width']}x{size['height']}"
