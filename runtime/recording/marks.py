"""The marks of damaged recordings, DATA/quarantine/<uuid>.json, and what it takes for one to go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runtime.core.errors import RecordingError
from runtime.recording.files import read_json
from runtime.recording.sealing import OUTCOME
from runtime.recording.verdict import Damage, IntegrityCheck

FOLDER = "quarantine"


@dataclass(frozen=True, slots=True)
class DamageMark:
    """Finding: `damage` as in Verdict.document; `seal` of the outcome then, "" for none, None: not known."""

    damage: list[dict[str, Any]]
    seal: str | None

    def is_resolved_by(self, verdict: IntegrityCheck) -> bool:
        """True if the same recording is whole again: not another one that was sealed since."""
        if verdict.state == "sound":
            return verdict.seal == self.seal if self.seal else self.seal is None or not verdict.repaired
        files = {one["file"] for one in self.damage}
        unsealed_then = bool(files) if self.seal == "" else self.seal is None and files == {OUTCOME}
        return verdict.state == "unsealed" and not verdict.why and unsealed_then


def mark_file(data: Path, uuid: str) -> Path:
    """Of one recording."""
    return data / FOLDER / f"{uuid}.json"


def data_of(folder: Path) -> Path | None:
    """The data folder that DATA/episodes/<uuid> lies in; None where it lies elsewhere."""
    episodes = folder.absolute().parent
    return episodes.parent if episodes.name == "episodes" else None


def read_mark(data: Path, uuid: str) -> DamageMark | None:
    """That of a recording; None where there is none. One that is damaged itself says nothing: without damage."""
    path = mark_file(data, uuid)
    if not path.exists():
        return None
    try:
        told = read_json(path)
    except RecordingError:
        told = {}
    damage, seal = told.get("damage"), told.get("seal")
    if not (isinstance(damage, list) and all(map(_is_damage_table, damage))):
        return DamageMark([], "")
    return DamageMark(damage, seal if isinstance(seal, str) else None)


def known_damage(verdict: IntegrityCheck) -> tuple[Damage, ...]:
    """The damage that an earlier look found, and that what was found now does not resolve."""
    data = data_of(verdict.path)
    mark = read_mark(data, verdict.path.name) if data else None
    if mark is None or mark.is_resolved_by(verdict):
        return ()
    spoiled = Damage(f"{FOLDER}/{verdict.path.name}.json", "is no mark any more, and was one")
    return tuple(_damage(one) for one in mark.damage) or (spoiled,)


def _damage(told: Mapping[str, Any]) -> Damage:
    spans = {name: tuple((first, last) for first, last in told[name]) for name in ("rows", "times")}
    return Damage(told["file"], told["what"], **spans)


def _is_damage_table(one: object) -> bool:
    """True if it is a table of Verdict.document."""
    if not isinstance(one, dict) or one.keys() != {"file", "what", "rows", "times", "text"}:
        return False
    words = all(isinstance(one[name], str) for name in ("file", "what", "text"))
    return words and _are_spans(one["rows"], int) and _are_spans(one["times"], float)


def _are_spans(value: object, kind: type) -> bool:
    """True if it is a list of [first, last] pairs."""
    spans = value if isinstance(value, list) else [None]
    return all(isinstance(span, list) and [type(end) for end in span] == [kind, kind] for span in spans)
