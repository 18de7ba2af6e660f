"""Redaction of a station's messages that would reveal its checkpoint; pure functions.

Visible keys are listed explicitly, so that anything else in a message is hidden by default.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from evaweb.blinding.visibility import COVERED, COVERED_AT_REST, HIDDEN, Visibility
from runtime.core.sentences import Sentence, from_wire, identity, shows, texts
from runtime.ipc.session_state import SessionState

# Visible keys of a snapshot: robot, bench, lease; nothing about the policy, its timing and its chunks.
_SHOWN = (
    "boot",
    "sequence",
    "clock",
    "station",
    "robot",
    "state",
    "state_is",
    "allowed",
    "guarded",
    "mode",
    "sim_state",
    "grippers",
    "drives",
    "collect",
    "simulated",
    "transport",
    "lease",
    "estop",
    "run",
    "link",
    "facts",
)
_COVERED: Mapping[str, Any] = {
    "phase": "",
    "stage": "idle",
    "stages": [],
    "setup_took": {},
    "first_action": {},
    "proposal": {},
    "validated": "",
    "task": "",
    "checkpoint": {},
    "policy": {"kind": "", "name": "", "answers": 0, "lost": False, "retry_in_s": 0.0, "rtc": {}},
    "strategy": "",
    "tuning": {},
    "last_run": {},
    "newest_event": 0,  # counts and gaps of event numbers could reveal a checkpoint
}
_CONTROL = ("rate", "engaged", "scheduling", "records_lost")
_CONTROL_COVERED = {"step": 0, "behaviour": "", "remaining": 0, "ticks": 0, "missed": 0}
_FACTS = ("strategies", "strategy")  # hidden facts: how the policy is queried
_JOINTS = ("measured", "commanded", "simulated", "engaged", "limited", "clock")

# Kinds of events whose text is shown without data; other kinds are hidden or handled in `_event`.
_EVENTS = ("camera_back", "camera_lost", "drives", "estopped", "labelled", "released")
# Hidden ground truth: operators score before they learn it, and the count of steps is the pace of the policy.
_JUDGED = ("milestones", "success", "over", "steps")


def redact_state(snapshot: Mapping[str, Any], sight: Visibility) -> dict[str, Any]:
    """Return a snapshot of the same structure in which revealing values are empty, with "veiled" set to True."""
    redacted = {key: snapshot[key] for key in _SHOWN if key in snapshot}
    covered = _cover(str(snapshot.get("state")))
    reason = (snapshot.get("sentences") or {}).get("reason")
    redacted["reason"] = _reason(snapshot.get("reason"), reason, sight, covered)
    redacted |= {key: empty for key, empty in _COVERED.items() if key in snapshot}
    if isinstance(snapshot.get("truth"), Mapping):
        redacted["truth"] = {key: fact for key, fact in snapshot["truth"].items() if key not in _JUDGED}
    if (snapshot.get("state_is") or {}).get("preparing"):
        redacted["stage"] = "setting up"
    if isinstance(snapshot.get("facts"), Mapping):
        redacted["facts"] = {key: value for key, value in snapshot["facts"].items() if key not in _FACTS}
    if isinstance(snapshot.get("control"), Mapping):
        control = snapshot["control"]
        redacted["control"] = _CONTROL_COVERED | {key: control[key] for key in _CONTROL if key in control}
    if isinstance(snapshot.get("recording"), Mapping):
        redacted["recording"] = dict(snapshot["recording"])
    if isinstance(snapshot.get("episode"), Mapping):
        redacted["episode"] = {
            key: snapshot["episode"][key] for key in ("uuid",) if key in snapshot["episode"]
        }
    if isinstance(snapshot.get("sentences"), Mapping):
        redacted["sentences"] = _sentences(snapshot, redacted)
        if isinstance(redacted["reason"], Sentence):
            redacted["sentences"]["reason"] = identity(redacted["reason"])
    return redacted | {"veiled": True}


def _cover(state: str) -> Sentence:
    """Return what is shown in place of a hidden reason for this state: what to do, if anything is to be done.

    It depends on the state alone.
    """
    covers: Mapping[str, Sentence] = {SessionState.IDLE: COVERED_AT_REST, SessionState.READY: HIDDEN}
    return covers.get(state, COVERED)


def _reason(text: object, sentence: object, visibility: Visibility, covered: str) -> str:
    """Return the reason for the station's state, or `covered` if the user may not see that reason.

    `text` is the reason. `sentence` has the pattern id and arguments of that text, or is None.
    """
    return visibility.redact_text(
        _sentence({"text": str(text or ""), **(sentence if isinstance(sentence, Mapping) else {})}), covered
    )


def _sentence(value: object) -> str:
    """Return a transmitted message as a Sentence; plain text if it has no valid id."""
    fields = value if isinstance(value, Mapping) else {"text": str(value or "")}
    text = str(fields.get("text") or "")
    try:
        return from_wire(text, fields.get("id") or "", fields.get("arguments") or {})
    except ValueError:
        return text


def _sentences(snapshot: Mapping[str, Any], redacted: Mapping[str, Any]) -> dict[str, Any]:
    """Return the references to sentences (id and arguments) whose text is the same in the redacted snapshot.

    A page uses such a reference to translate the text. A reference is left out if its arguments contain anything that
    the text does not show.
    """
    before, now = texts(snapshot), texts(redacted)
    return {
        path: reference
        for path, reference in snapshot["sentences"].items()
        if path in now and now[path] == before.get(path) and shows(now[path], reference["arguments"])
    }


def _identity(row: Mapping[str, Any], text: str) -> dict[str, Any]:
    """Return the id and arguments by which an event's text can be translated; {} if they may not be shown.

    They are shown only if the user sees the event's whole text, and if this text contains all arguments.
    """
    arguments = row.get("arguments") or {}
    if not row.get("id") or text != row.get("text") or not shows(text, arguments):
        return {}
    return {"id": row["id"], "arguments": arguments}


def redact_events(
    rows: Iterable[Mapping[str, Any]], sight: Visibility, last: int = 0
) -> list[dict[str, Any]]:
    """Return the events that reveal no policy, with new numbers.

    The new number of an event is its time [us], or the previous number plus 1 if that is larger; the first number is
    above `last`. The original numbers would have gaps, from which the number and the times of hidden events could be
    inferred.
    """
    events = []
    for row in rows:
        if (event := _event(row, sight)) is not None:
            last = max(int(1e6 * float(row.get("time") or 0.0)), last + 1)
            events.append({**event, "number": last})
    return events


def redact_joints(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the robot's joints without the policy's targets and contributing chunks."""
    return {key: content[key] for key in _JOINTS if key in content}


def redact_answer(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the visible data of the answer to a command."""
    return {key: data[key] for key in ("episode", "bench") if key in data}


def _event(row: Mapping[str, Any], visibility: Visibility) -> dict[str, Any] | None:
    kind, text = row.get("kind"), str(row.get("text") or "")
    times = {key: row[key] for key in ("time", "wall") if key in row}
    reason = _sentence((row.get("arguments") or {}).get("reason"))
    if kind == "command":  # "stop by ann: accepted", "setup by ann: refused, the reason"
        head, _, tail = text.partition(", ")
        text = (
            f"{head}, {visibility.redact_text(reason if reason == tail else tail, COVERED)}" if tail else head
        )
    elif kind == "state":  # "running -> holding: the reason"
        moved, _, tail = text.partition(": ")
        covered = next((_cover(state) for state in SessionState if moved.endswith(state.sentence)), COVERED)
        shown = visibility.redact_text(reason if reason == tail else tail, covered) if tail else ""
        text = f"{moved}: {shown}" if shown and shown != HIDDEN else moved
    elif kind in ("episode_opened", "episode_closed"):
        text = str(kind).replace("_", " ")
    elif kind not in _EVENTS:
        return None
    return {**times, "kind": kind, "text": text, "data": {}, **_identity(row, text)}
