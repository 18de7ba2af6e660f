"""Result of an integrity check of a recording, as sentences and as JSON."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from runtime.core.errors import RecordingError

UNSEALED = "it is from before recordings had digests: whether its files are as they were written is unknown"

State = Literal["sound", "damaged", "unsealed", "open"]


@dataclass(frozen=True, slots=True)
class Damage:
    """Damage of one file of an episode and its rows (lines in events.jsonl)."""

    file: str
    description: str
    rows: tuple[tuple[int, int], ...] = ()  # (first, last), both included
    times: tuple[tuple[float, float], ...] = ()  # of these rows [s since the start of the episode], if known

    @property
    def text(self) -> str:
        """Sentence for the operator."""
        unit = "lines" if self.file.endswith(".jsonl") else "rows"
        spans = [f"{first} to {last}" for first, last in self.rows]
        times = [f"{first:.2f} to {last:.2f}" for first, last in self.times]
        where = f", {unit} {', '.join(spans)}" if spans else ""
        return f"{self.file} {self.description}{where}" + (f" ({', '.join(times)} s)" if times else "")


@dataclass(frozen=True, slots=True)
class IntegrityCheck:
    """Result of the integrity check of one episode: "sound", "damaged", "unsealed" or "open".

    "unsealed" (no digests) means that nothing proves whether the files are as they were written, "open" that there is
    no outcome. `seal` is the seal in outcome.json, or in its copy if outcome.json is lost; "" if there is no seal.
    """

    path: Path
    state: State
    damage: tuple[Damage, ...] = ()
    bytes: int = 0  # number of bytes read
    seal: str = ""
    repaired: bool = False  # sealed by repair, so the seal proves nothing about the time before
    why: str = ""  # details on "unsealed" and "open"

    @property
    def text(self) -> str:
        """Sentence for the operator."""
        texts = {
            "sound": f"every file is as {'repair left it' if self.repaired else 'it was recorded'}",
            "unsealed": self.why or UNSEALED,
            "open": self.why or "it has no outcome: it is being recorded, or wants repair",
            "damaged": "; ".join(damage.text for damage in self.damage),
        }
        return texts[self.state]

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON."""
        damage = [
            {
                "file": entry.file,
                "what": entry.description,
                "rows": [list(span) for span in entry.rows],
                "times": [list(span) for span in entry.times],
                "text": entry.text,
            }
            for entry in self.damage
        ]
        fields = {"episode": self.path.name, "state": self.state, "text": self.text}
        return {**fields, "bytes": self.bytes, "damage": damage}


class DamagedError(RecordingError):
    """Error about a recording that was changed after it was recorded."""

    def __init__(self, verdict: IntegrityCheck) -> None:
        self.verdict = verdict
        super().__init__(
            f"{verdict.path} is damaged: {verdict.text}. It is left as it is and never published; bring its files "
            "back from a copy"
        )
