"""Choices of a script that it has not used yet: the older channel chooses first and commands later."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(slots=True)
class ScriptSelection:
    """The choices of one script; what is None or empty was not chosen, and the deployment's own holds."""

    task: str | None = None
    collect_task: str | None = None
    strategy: dict[str, Any] = field(default_factory=dict)
    mode: str | None = None
    target: list[float] | None = None  # joints [D] of `manual_qpos`

    def choose(self, **chosen: Any) -> None:
        """Remember; a strategy adds to the one that was chosen before."""
        for name, value in chosen.items():
            setattr(self, name, self.strategy | value if name == "strategy" else value)

    @property
    def setup(self) -> dict[str, Any]:
        """The arguments of a set-up with these choices."""
        wanted = {"task": self.task, "strategy": self.strategy or None}
        return {name: value for name, value in wanted.items() if value is not None}

    @property
    def run(self) -> dict[str, Any]:
        """The arguments of a run with these choices."""
        return {} if self.mode is None else {"mode": self.mode}
