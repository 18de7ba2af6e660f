"""A trial at the tabletop over each wire on a websocket: node, bench, lockstep and stand-in are the product's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import robots
from runtime.ipc.session_state import SessionState
from runtime.simulation.scripts.script import Script
from runtime.standins.faults import Fault
from runtime.standins.openpi_server import Behaviour, OpenpiServer
from runtime.standins.roboarena_server import RoboarenaBehaviour, RoboarenaServer
from runtime.standins.starvla_server import StarvlaBehaviour, StarvlaServer
from runtime.standins.xpolicylab_server import XpolicylabBehaviour, XpolicylabServer
from runtime.station.spec import StationSpec
from tests.runtime.simulation.tabletop_station import HORIZON, pick_and_place, served

ARENA = ['policy.kind="roboarena"', 'policy.cameras={cam_high="first", cam_wrist="wrist"}']
STARVLA = ['policy.kind="starvla"', 'policy.cameras=["cam_wrist", "cam_high"]']
XPOLICYLAB = ['policy.kind="xpolicylab"', 'policy.cameras={cam_high="cam_head", cam_wrist="cam_wrist"}']
SIZE = (240, 320)
ARM = robots.load_robot("ur5e")
LIMITS = f"{{low={list(map(float, ARM.lower))}, high={list(map(float, ARM.upper))}}}"


def arena_server(**arena: Any) -> Any:
    def made(spec: StationSpec, script: Script) -> RoboarenaServer:
        return RoboarenaServer(
            spec.robot, RoboarenaBehaviour(HORIZON, spec.rate, resolution=SIZE, **arena), 0, script
        )

    return made


def starvla_server(old: bool) -> Any:
    def made(spec: StationSpec, script: Script) -> StarvlaServer:
        star = StarvlaBehaviour(HORIZON, spec.rate, size=SIZE, views=("cam_wrist", "cam_high"), old=old)
        return StarvlaServer(spec.robot, star, 0, script)

    return made


def xpolicylab_server(spec: StationSpec, script: Script) -> XpolicylabServer:
    return XpolicylabServer(spec.robot, XpolicylabBehaviour(HORIZON, spec.rate), 0, script)


def rtc_server(dialect: Any) -> Any:
    def made(spec: StationSpec, script: Script) -> OpenpiServer:
        return OpenpiServer(spec.robot, Behaviour(HORIZON, spec.rate, rtc=dialect), 0, script)

    return made


TRIALS: dict[str, tuple[list[str], Any]] = {
    "roboarena": (ARENA, arena_server(reply="dict")),
    "velocities": (
        [*ARENA, 'policy.action_space="joint_velocity"', "policy.velocity_steps={}"],
        arena_server(reply="bare", space="joint_velocity"),
    ),
    "vllm": (
        [*ARENA, 'policy.numbering="1-based"', 'policy.action_keys=["arm", "gripper"]'],
        arena_server(variant="vllm", reply="parts", numbering=1),
    ),
    "starvla": (STARVLA, starvla_server(old=False)),
    "starvla-old": ([*STARVLA, f"policy.statistics={LIMITS}"], starvla_server(old=True)),
    "xpolicylab": (XPOLICYLAB, xpolicylab_server),
    "xpolicylab-poses": (
        [*XPOLICYLAB, 'policy.action_space="eef"', 'policy.observation_space="eef"'],
        xpolicylab_server,
    ),
}


TRIALS |= {
    dialect: (
        ['strategy.kind="rtc"', f'policy.rtc="{dialect}"', "policy.rtc_envelope={server_shift=25}"],
        rtc_server(dialect),
    )
    for dialect in ("prev_action", "openpi_rtc", "kai0", "async_rtc")
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("wire", TRIALS)
def test_a_policy_on_this_wire_puts_the_block_on_the_plate(wire: str, tmp_path: Path) -> None:
    assignments, serve = TRIALS[wire]
    trial = pick_and_place("tabletop_ur5e", 0, tmp_path, assignments, serve)
    assert trial.success, (trial.reason, trial.milestones, trial.events)
    assert trial.state is SessionState.RUNNING


def test_a_reset_that_the_server_does_not_acknowledge_holds_the_robot_with_what_it_said(
    tmp_path: Path,
) -> None:
    """The warm-up of set-up was a session; a run that went on in it would be of no worth."""
    refusing = arena_server(fault=Fault("reset_text"))
    with served("tabletop_ur5e", 0, tmp_path, ARENA, refusing) as (_, station):
        session = station.coordinator.session
        station.connect()
        station.until(lambda: session.state is not SessionState.DISCONNECTED, 5.0, "first observation")
        station.command("setup")
        station.until(lambda: session.state is not SessionState.SETTING_UP, 60.0, "set-up")
        assert session.state is SessionState.READY, session.reason
        station.command("run")
        station.until(lambda: session.state is not SessionState.RUNNING, 60.0, "the end of patience")
        assert session.state is SessionState.HOLDING
        assert "the policy server at ws://127.0.0.1" in session.reason
        assert "reports an error: done" in session.reason
