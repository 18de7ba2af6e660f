"""States of a station's session and their meanings, one row per state, for all readers of a snapshot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from enum import StrEnum
from typing import Any, Literal

from runtime.core.sentences import Sentence, checked, fixed

Tone = Literal["neutral", "ok", "active", "warn", "danger"]  # colours of pages


@dataclass(frozen=True, slots=True)
class StateMeaning:
    """Meaning of a session state; clients use it instead of names, so that they handle unknown states correctly."""

    label: str  # a Sentence if it is a known state
    tone: Tone
    connected: bool = True  # complete observations arrive, or did until it was stopped
    preparing: bool = False  # a set-up or homing is in progress, which Stop cancels
    set_up: bool = False  # ready with a policy or to collect, at the start pose
    run_open: bool = False  # Stop ends it
    moving: bool = False  # the robot may move by itself
    latched: bool = False  # nothing moves until the e-stop is released

    @property
    def at_work(self) -> bool:
        """Whether a set-up is in progress or a run is open, so that the policy is in use."""
        return self.preparing or self.run_open

    @property
    def idle(self) -> bool:
        """Whether nothing is set up, and a set-up could begin."""
        return self.connected and not (self.set_up or self.preparing or self.latched)

    @property
    def ready(self) -> bool:
        """Whether the station is set up and no run is open."""
        return self.set_up and not self.run_open

    @property
    def going(self) -> bool:
        """Whether a run is being executed."""
        return self.run_open and self.moving

    @property
    def held(self) -> bool:
        """Whether a run waits until it is resumed or stopped."""
        return self.run_open and not self.moving

    def to_dict(self) -> dict[str, Any]:
        """Return fields and properties, as in a snapshot under "state_is"."""
        return asdict(self) | {
            name: getattr(self, name) for name in ("at_work", "idle", "ready", "going", "held")
        }


class SessionState(StrEnum):
    """State of the session; every process and client uses these words."""

    DISCONNECTED = "disconnected"
    IDLE = "idle"
    SETTING_UP = "setting_up"
    READY = "ready"
    RUNNING = "running"
    HOLDING = "holding"
    FAULTED = "faulted"

    @property
    def sentence(self) -> Sentence:
        """Name of the state in sentences."""
        return _NAMES[self]

    @property
    def meaning(self) -> StateMeaning:
        """Meaning of the state."""
        return MEANINGS[self]

    def meaning_dict(self) -> dict[str, Any]:
        """Return the meaning of the state as a map, which is the entry "state_is" of a snapshot."""
        return self.meaning.to_dict()

    @classmethod
    def meaning_of(cls, word: str) -> StateMeaning | None:
        """Return the meaning of the state `word`; None if there is no such state."""
        return cls(word).meaning if word in cls._value2member_map_ else None


def _label(state: SessionState, english: str) -> Sentence:
    return fixed(f"state.{state}.label", english)


S = SessionState
MEANINGS: dict[SessionState, StateMeaning] = {
    S.DISCONNECTED: StateMeaning(_label(S.DISCONNECTED, "disconnected"), "neutral", connected=False),
    S.IDLE: StateMeaning(_label(S.IDLE, "idle"), "neutral"),
    S.SETTING_UP: StateMeaning(_label(S.SETTING_UP, "setting up"), "active", preparing=True, moving=True),
    S.READY: StateMeaning(_label(S.READY, "ready"), "active", set_up=True),
    S.RUNNING: StateMeaning(_label(S.RUNNING, "running"), "ok", set_up=True, run_open=True, moving=True),
    S.HOLDING: StateMeaning(_label(S.HOLDING, "holding"), "warn", set_up=True, run_open=True),
    S.FAULTED: StateMeaning(_label(S.FAULTED, "faulted"), "danger", latched=True),
}
_NAMES = {state: fixed(f"state.{state}", state.value) for state in SessionState}


def complete_state_meaning(said: Mapping[str, Any]) -> dict[str, Any]:
    """Return the snapshot `said` of a station of any version, with a complete "state_is".

    Missing entries are derived from its "state"; invalid "sentences" are removed. An unknown state is neutral: nothing
    is in progress, and it counts as idle only if the station itself reports that.
    """
    word, meaning = str(said["state"]), said.get("state_is") or {}
    row = SessionState.meaning_of(word)
    unknown = {} if row else {"idle": False}
    row = row or StateMeaning(word.replace("_", " "), "neutral")
    row = replace(row, **{field.name: meaning[field.name] for field in fields(row) if field.name in meaning})
    sentences = {"sentences": checked(said["sentences"])} if "sentences" in said else {}
    return {**said, "state_is": {**row.to_dict(), **unknown, **meaning}, **sentences}
