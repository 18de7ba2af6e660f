"""The states of a station's session, and what each means: one row a state, for all who read a snapshot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from enum import StrEnum
from typing import Any, Literal

from runtime.core.sentences import Sentence, checked, fixed

Tone = Literal["neutral", "ok", "active", "warn", "danger"]  # the colours of pages


@dataclass(frozen=True, slots=True)
class StateMeaning:
    """What a state says: clients ask these, so that a state that they have never heard of is read right."""

    label: str  # a Sentence where it is one of ours
    tone: Tone
    connected: bool = True  # complete observations arrive, or did until it was stopped
    preparing: bool = False  # a set-up or a way home goes on, which Stop cancels
    set_up: bool = False  # with a policy, or to collect, and where it is to begin
    run_open: bool = False  # Stop ends it
    moving: bool = False  # the robot may move by itself
    latched: bool = False  # nothing moves until the e-stop is released

    @property
    def at_work(self) -> bool:
        """Whether the policy is used, or may be in a moment."""
        return self.preparing or self.run_open

    @property
    def idle(self) -> bool:
        """Whether nothing is set up, and nothing keeps a set-up from beginning."""
        return self.connected and not (self.set_up or self.preparing or self.latched)

    @property
    def ready(self) -> bool:
        """Whether it is set up and no run is open."""
        return self.set_up and not self.run_open

    @property
    def going(self) -> bool:
        """Whether a run goes on."""
        return self.run_open and self.moving

    @property
    def held(self) -> bool:
        """Whether a run waits until it is resumed or stopped."""
        return self.run_open and not self.moving

    def to_dict(self) -> dict[str, Any]:
        """The row and what follows from it, as the snapshot has it under "state_is"."""
        return asdict(self) | {
            name: getattr(self, name) for name in ("at_work", "idle", "ready", "going", "held")
        }


class SessionState(StrEnum):
    """The session's state; one word each, the same everywhere."""

    DISCONNECTED = "disconnected"
    IDLE = "idle"
    SETTING_UP = "setting_up"
    READY = "ready"
    RUNNING = "running"
    HOLDING = "holding"
    FAULTED = "faulted"

    @property
    def sentence(self) -> Sentence:
        """Its name in sentences."""
        return _NAMES[self]

    @property
    def meaning(self) -> StateMeaning:
        """Its row."""
        return MEANINGS[self]

    def meaning_dict(self) -> dict[str, Any]:
        """What it means, as the snapshot has it under "state_is"."""
        return self.meaning.to_dict()

    @classmethod
    def meaning_of(cls, word: str) -> StateMeaning | None:
        """What a state of that name means; None for one that there is not."""
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
    """`said` of a station of whatever version, its "state_is" whole: what it leaves out follows from its "state".

    Of its "sentences" those are kept that are some.
    A state that is not known here is neutral: nothing goes on, and that it is idle only the station may say.
    """
    word, told = str(said["state"]), said.get("state_is") or {}
    row = SessionState.meaning_of(word)
    unknown = {} if row else {"idle": False}
    row = row or StateMeaning(word.replace("_", " "), "neutral")
    row = replace(row, **{field.name: told[field.name] for field in fields(row) if field.name in told})
    known = {"sentences": checked(said["sentences"])} if "sentences" in said else {}
    return {**said, "state_is": {**row.to_dict(), **unknown, **told}, **known}
