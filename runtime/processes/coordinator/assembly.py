"""Assembly of the coordinator from its components, for a process and for lockstep."""

from __future__ import annotations

import uuid
from functools import partial

from runtime.core.clock import Clock
from runtime.ipc.bus import Endpoints, EventLog
from runtime.ipc.messages import Event, ReceptionReport
from runtime.ipc.session_state import SessionState
from runtime.ipc.shared_state import SharedState
from runtime.kinematics.base import ChainForward
from runtime.kinematics.lazy import LazyKinematics
from runtime.processes.coordinator.builders import (
    MakePolicy,
    kinematics_compiled,
    make_kinematics,
    make_policy,
)
from runtime.processes.coordinator.control_queue import ControlQueue
from runtime.processes.coordinator.coordinator import Coordinator
from runtime.processes.coordinator.demonstrations import Demonstrations
from runtime.processes.coordinator.health_monitor import HealthMonitor
from runtime.processes.coordinator.inference.chunk_mixture import Mixture
from runtime.processes.coordinator.inference.inference import FaultTimeouts, Inference
from runtime.processes.coordinator.inference.policy_observation import PolicyObservation, StalenessLimits
from runtime.processes.coordinator.inference.requests import MissBound, PolicyRequests
from runtime.processes.coordinator.inference.rtc_prefix import RtcPrefix
from runtime.processes.coordinator.inference.runners import Runner
from runtime.processes.coordinator.lease import Lease
from runtime.processes.coordinator.manual.manual_control import ManualControl
from runtime.processes.coordinator.manual.targets import Targets
from runtime.processes.coordinator.operations import SessionActions, SessionComponents
from runtime.processes.coordinator.preflight_service import PreflightService
from runtime.processes.coordinator.runs import Runs
from runtime.processes.coordinator.session.machine import SessionMachine
from runtime.processes.coordinator.session.tuning import strategy_of
from runtime.processes.coordinator.setup.sequence import SetUp
from runtime.processes.coordinator.snapshot import control_figures, station_facts
from runtime.processes.coordinator.timing_report import TimingReport
from runtime.safety.settings import SafetySettings
from runtime.spaces.conversion import ActionSpaces
from runtime.station.run import Provenance
from runtime.station.spec import StationSpec


def assemble(
    spec: StationSpec,
    shared: SharedState,
    clock: Clock,
    runner: Runner,
    people: Clock | None = None,
    make_policy: MakePolicy = make_policy,
) -> Coordinator:
    """Return the coordinator of a station.

    Args:
        spec: Specification of the station.
        shared: Shared state of the station's processes.
        clock: Clock of the runtime.
        runner: Executor of the calls to the policy.
        people: Clock of leases and of the validity of commands; None for `clock`.
        make_policy: Constructor of the policy.
    """

    # Callbacks of components to the coordinator, which does not exist yet.
    def say(event: Event) -> None:
        coordinator.emit(event)

    def state() -> SessionState:
        return coordinator.session.state

    def reception() -> ReceptionReport:
        return coordinator.inbox.reception_report

    boot, people = str(uuid.uuid4()), people or clock
    lease, orders = Lease(spec.deployment.lease.ttl_s), ControlQueue(shared)
    kinematics = LazyKinematics(
        ChainForward(spec.robot),
        partial(make_kinematics, spec),
        runner.run_in_background,
        partial(kinematics_compiled, spec),
    )
    spaces = ActionSpaces(spec.robot, kinematics, spec.rate)
    inference = _inference(spec, shared, clock, runner, orders, kinematics, make_policy)
    endpoints = Endpoints(spec.deployment.station_dir)
    setup = SetUp(spec, inference, orders, shared, clock, reception, kinematics.compile)
    health = HealthMonitor(spec, shared, lease, clock, people, reception, partial(endpoints.served, "panel"))
    runs = Runs(
        spec,
        shared,
        clock,
        inference,
        orders,
        Provenance(spec, boot),
        lambda: control_figures(shared, spec.rate),
        kinematics.prepare,
    )
    manual = ManualControl(spec, shared, orders, runs, Targets(spec, spaces, kinematics))
    collecting = Demonstrations(spec, shared, clock, inference, setup, lambda: runs.open, say)
    parts = SessionComponents(shared, clock, orders, inference, setup, runs, manual, collecting)
    operations = SessionActions(spec, parts, state, health.silent_sibling, say, make_policy)
    settings = spec.deployment.control
    coordinator = Coordinator(
        boot=boot,
        shared=shared,
        clock=clock,
        client_clock=people,
        deployment_spec=spec.resolved,
        facts=station_facts(spec),
        events=EventLog(),
        lease=lease,
        orders=orders,
        spaces=spaces,
        inference=inference,
        setup=setup,
        runs=runs,
        manual=manual,
        collecting=collecting,
        health=health,
        timing=TimingReport(shared, spec.rate, settings.realtime_priority, settings.realtime == "auto"),
        operations=operations,
        preflights=PreflightService(lambda: operations.spec, spec, state, say, clock),
        session=SessionMachine(operations, lease, boot, people.now),
    )
    return coordinator


def _bound(safety: SafetySettings) -> MissBound | None:
    refuses = safety.missed_pose == "refuse"
    return MissBound(safety.missed_pose_m, safety.missed_pose_rad, safety.jump) if refuses else None


def _inference(
    spec: StationSpec,
    shared: SharedState,
    clock: Clock,
    runner: Runner,
    orders: ControlQueue,
    kinematics: LazyKinematics,
    make_policy: MakePolicy,
) -> Inference:
    """Return the component that queries the policy.

    It has action spaces of its own, because they are used on the thread of the policy call.
    """
    settings = spec.deployment
    ages = StalenessLimits(spec.rate, settings.safety.joint_age_s, settings.safety.picture_age_s)
    requests = PolicyRequests(
        make_policy(spec, clock),
        settings.task,
        ActionSpaces(spec.robot, kinematics, spec.rate),
        PolicyObservation(shared, clock, ages),
        runner,
        clock,
        _bound(settings.safety),
    )
    patience = FaultTimeouts(settings.control.starvation_hold_s, settings.faults.patience_s)
    prefix = RtcPrefix(spec.rate, Mixture(spec.dims, spec.robot))
    return Inference(requests, strategy_of(spec), shared, orders, clock, patience, prefix)
