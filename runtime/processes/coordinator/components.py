"""All components of the coordinator in one object, for those modules of the coordinator that use many of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from runtime.config.loader import Resolved
from runtime.core.clock import Clock
from runtime.ipc.bus import EventLog
from runtime.ipc.messages import Event
from runtime.ipc.shared_state import SharedState
from runtime.processes.coordinator.control_queue import ControlQueue
from runtime.processes.coordinator.demonstrations import Demonstrations
from runtime.processes.coordinator.health_monitor import HealthMonitor
from runtime.processes.coordinator.inference.inference import Inference
from runtime.processes.coordinator.lease import Lease
from runtime.processes.coordinator.manual.manual_control import ManualControl
from runtime.processes.coordinator.operations import SessionActions
from runtime.processes.coordinator.preflight_service import PreflightService
from runtime.processes.coordinator.runs import Runs
from runtime.processes.coordinator.session.machine import SessionMachine
from runtime.processes.coordinator.session.transitions import SessionEvent
from runtime.processes.coordinator.setup.sequence import SetUp
from runtime.processes.coordinator.timing_report import TimingReport
from runtime.spaces.conversion import ActionSpaces
from runtime.station.spec import StationSpec


@dataclass(eq=False)
class Components(ABC):
    """Components of a coordinator, and the methods by which they emit, publish and handle events."""

    boot: str
    shared: SharedState
    clock: Clock
    client_clock: Clock  # of leases and of command validity; lockstep has another
    deployment_spec: Resolved  # as at the station's start
    facts: Mapping[str, Any]  # constants of the station for snapshots
    events: EventLog
    lease: Lease
    orders: ControlQueue
    spaces: ActionSpaces
    inference: Inference
    setup: SetUp
    runs: Runs
    manual: ManualControl
    collecting: Demonstrations
    health: HealthMonitor
    timing: TimingReport
    operations: SessionActions
    preflights: PreflightService
    session: SessionMachine

    @property
    def spec(self) -> StationSpec:
        """Specification of the last set-up or tuning."""
        return self.operations.spec

    @abstractmethod
    def emit(self, event: Event) -> None:
        """Emit an event of the coordinator: to log, clients and episode."""

    @abstractmethod
    def record_event(self, event: Event) -> None:
        """Publish an event that another process has emitted. That process writes the event to the episode itself."""

    @abstractmethod
    def handle_event(self, happening: SessionEvent, reason: str, process: str = "") -> None:
        """Pass an event to the session and its components; `process` is the restarted process, "" for other events."""
