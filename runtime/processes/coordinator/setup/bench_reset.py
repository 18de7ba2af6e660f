"""Reset of a simulated bench: requested from its node until it is confirmed."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping
from typing import Any

from runtime.benches.schema import load_schema
from runtime.core.clock import Clock
from runtime.core.errors import SetupError
from runtime.core.sentences import Pattern, fixed
from runtime.ipc.command_arguments import BenchRequest
from runtime.ipc.messages import Event, ReceptionReport
from runtime.processes.coordinator.control_queue import ControlQueue
from runtime.station.spec import StationSpec

_NOT_SIMULATED = Pattern(
    "bench.not_simulated",
    "setup: bench with seed {seed}: the transport is not declared simulated; allowed: no bench, or a "
    "node that simulates one, with transport.simulated = true in the deployment",
)
_RESET_ALREADY = Pattern(
    "bench.reset_already",
    "setup: bench.id = {identity!r}: the bench was reset under this id already; allowed: an id of its "
    "own for each reset, or none",
)
_OTHER_BENCH = Pattern(
    "bench.other_bench",
    "setup: the scene is laid out for the simulated bench {wanted!r}; this station has {own!r}",
)
_SAME_NAME = fixed(
    "bench.same_name", ", whose bench.toml is another one: start the station, or the lab, anew after a change"
)
_NO_LAYOUT = Pattern("bench.no_layout", "setup: bench.positions: {why}")
_CANNOT_RESET = Pattern("bench.cannot_reset", "the bench cannot be reset: {why}")
_NOT_RESET = Pattern("bench.not_reset", "the bench was not reset within {seconds:g} s: {why}")
_NODE_REFUSED = Pattern("bench.node_refused", "the robot refused it ({reasons})")
_NO_FACTORS = Pattern(
    "bench.no_factors", "the node reset the bench without the factors ({factors}): it does not simulate them"
)
_NODE_SILENT = fixed("bench.node_silent", "the node does not answer to it")
_NO_TRUTH = fixed("bench.no_truth", "the node reports no ground truth of a bench; does it simulate one?")

_RESET_S = 3.0  # [s] for a simulated bench to be laid out
_REPEAT_S = 0.2  # [s] a control word may be lost


class BenchReset:
    """Reset of a simulated bench by its node; one reset at a time."""

    def __init__(
        self, spec: StationSpec, orders: ControlQueue, clock: Clock, reception: Callable[[], ReceptionReport]
    ) -> None:
        self._plan = spec
        self._orders = orders
        self._clock = clock
        self._reception = reception  # its latest report
        self._refused = ""

    def from_request(self, bench: BenchRequest | None) -> dict[str, Any] | None:
        """Return the reset to send to the node; None if `bench` is None.

        Raises:
            SetupError: the transport simulates no bench, its bench does not accept the layout, or a reset with this id
                was done already.
        """
        if bench is None:
            return None
        if not self._plan.capabilities.bench:
            raise SetupError(_NOT_SIMULATED(seed=bench.seed))
        own = self._plan.capabilities.bench
        schema = load_schema(own)
        if bench.schema_digest is not None and bench.schema_digest != schema.digest:
            same = _SAME_NAME if bench.of == own else ""
            raise SetupError(_OTHER_BENCH(wanted=bench.of or "", own=own) + same)
        if bench.schema_digest is None and bench.of is not None and bench.of != own:
            raise SetupError(_OTHER_BENCH(wanted=bench.of, own=own))
        problems = (
            *schema.problems(bench.positions or {}),
            *schema.factor_problems(bench.factors or {}),
            *schema.choice_problems(bench.choices or {}),
        )
        if problems:
            raise SetupError(_NO_LAYOUT(why=problems[0]))
        if bench.id is not None and bench.id == self._reception().truth.get("reset"):
            raise SetupError(_RESET_ALREADY(identity=bench.id))
        asked = bench.model_dump(exclude_none=True, exclude={"of", "schema_digest"})
        return asked | {"id": bench.id or str(uuid.uuid4())}

    def start(self, reset: dict[str, Any]) -> None:
        """Begin to request `reset`, the result of `from_request`; `is_done` sends and repeats the request."""
        self._reset = reset
        self._refused = ""
        self._since = self._clock.now()
        self._asked_at = float("-inf")
        self._refused_before = self._refused_by_node()

    def on_event(self, event: Event) -> None:
        """Process an event of control; it may report that the control word of the reset could not be sent."""
        if event.kind == "word_refused":
            self._refused = event.text

    def is_done(self) -> bool:
        """Return True if the bench was reset; repeat the request if that is due.

        Raises:
            SetupError: the reset was refused, or did not happen in time.
        """
        truth = self._reception().truth
        if truth.get("reset") == self._reset["id"]:
            for key in ("factors", "choices"):
                wanted = self._reset.get(key) or {}
                if truth.get(key, {}) != wanted:
                    raise SetupError(_NO_FACTORS(factors=", ".join(wanted)))
            return True
        unlaid = truth.get("refused")
        if isinstance(unlaid, Mapping) and unlaid.get("id") == self._reset["id"]:
            raise SetupError(_CANNOT_RESET(why=unlaid.get("why", "")))
        now = self._clock.now()
        if self._refused:
            raise SetupError(_CANNOT_RESET(why=self._refused))
        if now - self._since > _RESET_S:
            raise SetupError(_NOT_RESET(seconds=_RESET_S, why=self._why_not()))
        if now - self._asked_at >= _REPEAT_S:
            self._asked_at = now
            self._orders.send_node_request("scene_reset", self._reset)
        return False

    def _why_not(self) -> str:
        if not self._reception().truth:
            return _NO_TRUTH
        before = self._refused_before
        new = [reason for reason, count in self._refused_by_node().items() if count > before.get(reason, 0)]
        return _NODE_REFUSED(reasons=", ".join(new)) if new else _NODE_SILENT

    def _refused_by_node(self) -> dict[str, int]:
        prefix = "node_refused."
        faults = self._reception().faults.items()
        return {name.removeprefix(prefix): count for name, count in faults if name.startswith(prefix)}
