"""Report of a preflight, for programs and people."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from runtime.preflight.verdict import PreflightStage, PreflightVerdict

_LONGEST_TEXT, _LONGEST_LIST, _DEEPEST = 300, 40, 6  # limits of a server's metadata


@dataclass(frozen=True, slots=True)
class Call:
    """Call to the policy (connect, reset or infer), its duration [ms], and whether it succeeded."""

    name: str
    ms: float
    ok: bool
    note: str = ""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Last response: `rows` of `width` values as the server sent them, at `rate` [Hz], `seconds` of motion.

    Converted to commands, it has `command_rows` rows of `joints` values at the control rate. `first_away` [rad] is the
    distance of the first action from the robot's pose, found at the joint `first_joint`. `beyond_limits` is the number
    of command rows that leave the joint limits.
    """

    rows: int
    width: int
    space: str
    mode: str
    rate: float
    seconds: float
    command_rows: int
    joints: int
    first_away: float
    first_joint: str
    beyond_limits: int


@dataclass(frozen=True, slots=True)
class Report:
    """Report of a preflight: its verdict, the stage in which it was reached, and all measurements until then.

    `endpoint` is the policy's address, "" for a policy without a server; `name` is the server's own name. `metadata` is
    cut to a length that a page can show. `notes` are remarks that do not prevent a set-up.
    """

    verdict: PreflightVerdict
    stage: PreflightStage
    sentence: str
    advice: str = ""
    kind: str = ""
    endpoint: str = ""
    name: str = ""
    robot: str = ""
    control_rate: float = 0.0
    task: str = ""
    seconds: float = 0.0
    calls: tuple[Call, ...] = ()
    chunk: Chunk | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """True if a set-up could continue."""
        return self.verdict is PreflightVerdict.OK

    @property
    def warm_up_ms(self) -> float | None:
        """Duration of the first response [ms], which may include compiling a model."""
        return self._inferred(0)

    @property
    def latency_ms(self) -> float | None:
        """Duration of the second response [ms], as expected in a run."""
        return self._inferred(1)

    def _inferred(self, number: int) -> float | None:
        answers = [call.ms for call in self.calls if call.name == "infer" and call.ok]
        return answers[number] if number < len(answers) else None

    def to_dict(self) -> dict[str, Any]:
        """Return the report as a dict of JSON's own types."""
        fields = asdict(self)
        return {
            **fields,
            "verdict": str(self.verdict),
            "stage": str(self.stage),
            "calls": list(fields["calls"]),
            "notes": list(self.notes),
            "metadata": truncate_value(self.metadata),
            "ok": self.ok,
            "warm_up_ms": self.warm_up_ms,
            "latency_ms": self.latency_ms,
        }

    def lines(self) -> list[str]:
        """Return the report as lines for a terminal."""
        lines = [f"{self.verdict}  at {self.stage}", self.sentence]
        lines += [self.advice] if self.advice else []
        lines += [f"policy    {self._policy()}"] if self.kind else []
        lines += [f"{call.name:<9} {call.ms:.0f} ms{_call_summary(call)}" for call in self.calls]
        lines += [f"chunk     {chunk_summary(self.chunk)}"] if self.chunk else []
        lines += [f"metadata  {key} = {value}" for key, value in truncate_value(self.metadata).items()]
        return lines + [f"note      {note}" for note in self.notes]

    def _policy(self) -> str:
        return ", ".join(filter(None, [self.kind, self.name, self.endpoint, f"for {self.robot}"]))


def chunk_summary(chunk: Chunk) -> str:
    """Return the chunk in one line."""
    return (
        f"[{chunk.rows}, {chunk.width}] {chunk.mode} {chunk.space} at {chunk.rate:g} Hz, {chunk.seconds:.2f} s; "
        f"{chunk.command_rows} rows of {chunk.joints} joints at the control rate"
    )


def truncate_value(value: Any, depth: int = 0) -> Any:
    """Return a server's value in a form for JSON and people; long or deeply nested parts are cut."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, np.ndarray):
        return f"array {list(value.shape)} {value.dtype}"
    if isinstance(value, bytes | bytearray):
        return f"{len(value)} bytes"
    if isinstance(value, Mapping | list | tuple) and depth >= _DEEPEST:
        return "..."
    if isinstance(value, Mapping):
        truncated = {
            str(key)[:_LONGEST_TEXT]: truncate_value(item, depth + 1)
            for key, item in list(value.items())[:_LONGEST_LIST]
        }
        return truncated | (
            {"...": f"{len(value) - _LONGEST_LIST} more"} if len(value) > _LONGEST_LIST else {}
        )
    if isinstance(value, list | tuple):
        more = [f"... {len(value) - _LONGEST_LIST} more"] if len(value) > _LONGEST_LIST else []
        return [truncate_value(item, depth + 1) for item in value[:_LONGEST_LIST]] + more
    text = str(value)
    return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."


def _call_summary(call: Call) -> str:
    return f"  ({call.note})" if call.note else "" if call.ok else "  (failed)"
