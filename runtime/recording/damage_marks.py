"""Marks of damaged recordings, DATA/quarantine/<uuid>.json, and the condition for their removal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runtime.core.errors import RecordingError
from runtime.recording.files import read_json
from runtime.recording.integrity import Damage, IntegrityCheck
from runtime.recording.outcome_seal import OUTCOME

FOLDER = "quarantine"


@dataclass(frozen=True, slots=True)
class DamageMark:
    """Damage found in a recording.

    `damage` has the form of `IntegrityCheck.to_dict`. `seal` is the seal that outcome.json had when the damage was
    found; "" if it had none, None if that is unknown.
    """

    damage: list[dict[str, Any]]
    seal: str | None

    def is_resolved_by(self, verdict: IntegrityCheck) -> bool:
        """Return True if the check `verdict` shows that the recording is intact again.

        A recording with another seal than the mark's does not count as intact again, because it was sealed after the
        damage.
        """
        if verdict.state == "sound":
            return verdict.seal == self.seal if self.seal else self.seal is None or not verdict.repaired
        files = {entry["file"] for entry in self.damage}
        unsealed_then = bool(files) if self.seal == "" else self.seal is None and files == {OUTCOME}
        return verdict.state == "unsealed" and not verdict.why and unsealed_then


def mark_file(data: Path, uuid: str) -> Path:
    """Return the path of a recording's mark."""
    return data / FOLDER / f"{uuid}.json"


def data_of(folder: Path) -> Path | None:
    """Return the data folder of DATA/episodes/<uuid>; None for an episode elsewhere."""
    episodes = folder.absolute().parent
    return episodes.parent if episodes.name == "episodes" else None


def read_mark(data: Path, uuid: str) -> DamageMark | None:
    """Return the mark of a recording, or None if there is none; an unreadable mark is returned without damage."""
    path = mark_file(data, uuid)
    if not path.exists():
        return None
    try:
        fields = read_json(path)
    except RecordingError:
        fields = {}
    damage, seal = fields.get("damage"), fields.get("seal")
    if not (isinstance(damage, list) and all(map(_is_damage_table, damage))):
        return DamageMark([], "")
    return DamageMark(damage, seal if isinstance(seal, str) else None)


def known_damage(verdict: IntegrityCheck) -> tuple[Damage, ...]:
    """Return damage found by an earlier check that the check `verdict` does not resolve."""
    data = data_of(verdict.path)
    mark = read_mark(data, verdict.path.name) if data else None
    if mark is None or mark.is_resolved_by(verdict):
        return ()
    spoiled = Damage(f"{FOLDER}/{verdict.path.name}.json", "is no mark any more, and was one")
    return tuple(_damage(entry) for entry in mark.damage) or (spoiled,)


def _damage(fields: Mapping[str, Any]) -> Damage:
    spans = {name: tuple((first, last) for first, last in fields[name]) for name in ("rows", "times")}
    return Damage(fields["file"], fields["what"], **spans)


def _is_damage_table(value: object) -> bool:
    """Return True if the value has the form of one damage in `IntegrityCheck.to_dict`."""
    if not isinstance(value, dict) or value.keys() != {"file", "what", "rows", "times", "text"}:
        return False
    are_texts = all(isinstance(value[name], str) for name in ("file", "what", "text"))
    return are_texts and _are_spans(value["rows"], int) and _are_spans(value["times"], float)


def _are_spans(value: object, kind: type) -> bool:
    """Return True if the value is a list of [first, last] pairs whose ends are of type `kind`."""
    spans = value if isinstance(value, list) else [None]
    return all(isinstance(span, list) and [type(end) for end in span] == [kind, kind] for span in spans)
