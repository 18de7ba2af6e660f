"""The demo's bench in lockstep: the same course to the tick, however long anything took."""

from __future__ import annotations

import shlex
import time
import uuid
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robots
from runtime.config import loader
from runtime.core.clock import VirtualClock
from runtime.core.errors import SetupError
from runtime.ipc.identity import LOCAL
from runtime.ipc.messages import Ack, Command
from runtime.ipc.session_state import SessionState
from runtime.processes.lockstep.server import ServedLockstep
from runtime.recording.reader import open_episode
from runtime.simulation.bench.tabletop import Tabletop
from runtime.simulation.contact.bench import ContactTabletop
from runtime.simulation.environments import BenchEnvironment, make_environment
from runtime.simulation.node import parser
from runtime.standins import lockstep, serve
from runtime.standins.lockstep import SuccessDetector, in_process_peers
from runtime.station.checks import check_deployment
from tests.runtime.lockstep_station import column
from tests.runtime.simulation.tabletop_station import DEPLOYMENTS, SlowEye

LINE = "openpi --robot agilex_piper --behaviour pick_place --port 0 --seed 3 --noise {}"
DELAYS_MS = (80, 250)  # of the two policies
TURNS = 200_000


@dataclass(frozen=True)
class Course:
    """What there is of a trial: what was sent at which step of the station, how it ended, what the bench says."""

    sent: np.ndarray[Any, Any]
    steps: np.ndarray[Any, Any]
    reason: str
    truth: dict[str, Any]
    delays: set[int]


class Operator:
    """Who sets up and runs trial after trial, at once, or after so many turns and not before a recording is closed."""

    def __init__(self, station: ServedLockstep, dawdles: int) -> None:
        self.station, self._dawdles = station, dawdles
        self._given: list[str] = []
        self._ended: list[tuple[str, set[int]]] = []
        station.connect()
        self._until(SessionState.IDLE)
        self._give("lease_claim")

    def trial(self, policy: dict[str, Any], seed: int, seconds: float) -> None:
        bench = {"id": str(uuid.uuid4()), "seed": seed}
        self._give("setup", policy=policy, bench=bench)
        self._until(SessionState.READY, SessionState.IDLE)
        session, runs = self.station.coordinator.session, self.station.coordinator.runs
        assert session.state is SessionState.READY, session.reason
        self._given.append(self._give("run", duration_s=seconds).data["episode"])
        self._until(SessionState.READY)
        self._ended.append((session.reason, set(self.station.coordinator.inference.metrics.delays)))
        while self._dawdles and runs.last_episode.get("uuid") != self._given[-1]:
            self.station.poll()

    def courses(self) -> list[Course]:
        """Of all trials, once all recordings are closed."""
        runs, found = self.station.coordinator.runs, []
        while runs.last_episode.get("uuid") != self._given[-1]:
            self.station.poll()
        for uuid_, (reason, delays) in zip(self._given, self._ended, strict=True):
            episode = open_episode(self.station.spec.deployment.episodes_dir / uuid_)
            truth = next(event["data"] for event in episode.events if event["kind"] == "truth")
            said = {key: value for key, value in truth.items() if key not in ("episode", "reset")}
            sent, steps = column(episode.rows, "action"), column(episode.rows, "step")
            found.append(Course(sent, steps, reason, said, delays))
        return found

    def _give(self, kind: str, **arguments: Any) -> Ack:
        for _ in range(1 + self._dawdles):  # nobody decides by what is not published yet
            self.station.poll()
        main = self.station.coordinator
        epoch = 0 if kind == "lease_claim" else main.lease.epoch
        ack = main.handle(
            Command(
                str(uuid.uuid4()),
                kind,
                arguments,
                holder="script",
                role=LOCAL,
                epoch=epoch,
                boot=main.boot,
                sequence=main.session.sequence,
            )
        )
        assert ack.status == "accepted", ack.reason
        return ack

    def _until(self, *states: SessionState) -> None:
        for _ in range(TURNS):
            if self.station.coordinator.session.state in states:
                return
            self.station.poll()
        raise AssertionError(f"never {states}")


def courses(
    data: Path,
    trials: Sequence[tuple[int, int, float]],
    dawdles: int = 0,
    slow_s: float = 0.0,
    make: type[Tabletop | ContactTabletop] = Tabletop,
) -> list[Course]:
    """Trials of (policy, seed, seconds), at a bench whose policies may take longer than is declared."""
    clock = VirtualClock()
    lines = [LINE.format(1), LINE.format(14) + " --failure-rate 0.4"]
    servers: list[Any] = [
        serve.build_server(serve.parser().parse_args(shlex.split(line)), clock) for line in lines
    ]
    for server in servers:
        reply = server.reply

        def replying(*given: Any, reply: Any = reply) -> Any:
            time.sleep(slow_s)
            return reply(*given)

        server.reply = replying
    urls = [str(server.start()["url"]) for server in servers]
    given = [f'data_dir="{data}"', f'policy.url="{urls[0]}"', "recording.export=false", "lease.ttl_s=600"]
    made = check_deployment(loader.load(DEPLOYMENTS / "tabletop.toml", given))
    around = SlowEye(made.robot, make(made.robot, 1))
    options = parser().parse_args(["--robot", made.robot.name, "--bench", "tabletop", "--seed", "1"])
    over, peers = SuccessDetector(around.truth, clock), in_process_peers(made, clock, around, options)
    with closing(ServedLockstep(made, clock, over, peers=peers)) as station:
        operator = Operator(station, dawdles)
        for policy, seed, seconds in trials:
            operator.trial({"url": urls[policy], "delay_ms": DELAYS_MS[policy]}, seed, seconds)
        found = operator.courses()
    for server in servers:
        server.close()
    return found


@pytest.mark.exhaustive
@pytest.mark.parametrize("make", [Tabletop, ContactTabletop])
def test_the_same_plan_gives_the_same_course_however_busy_the_machine(
    make: type[Tabletop | ContactTabletop], tmp_path: Path
) -> None:
    trials = [(1, 4, 3.0), (0, 5, 3.0)]
    *first, skilled = courses(tmp_path / "first", [*trials, (0, 4, 20.0)], make=make)
    second = courses(tmp_path / "second", trials, dawdles=7, slow_s=0.01, make=make)

    for one, other in zip(first, second, strict=True):
        assert np.array_equal(one.sent, other.sent)
        assert np.array_equal(one.steps, other.steps)
        assert (one.reason, one.truth) == (other.reason, other.truth)
    assert skilled.truth["success"] is True
    assert skilled.reason == "the simulated bench has said success for 1 s"
    reached = skilled.truth["reached"]
    assert list(reached) == ["grasped", "lifted", "over_plate", "placed"]
    assert sorted(reached.values()) == list(reached.values())
    assert len(skilled.steps) / 30 == pytest.approx(reached["placed"] + 1.0, abs=0.5)
    assert [course.delays for course in first] == [{8}, {3}]  # 250 and 80 ms, as declared


def test_a_run_is_over_once_success_has_lasted(tmp_path: Path) -> None:
    clock, truth = VirtualClock(), {"success": False}
    over = SuccessDetector(lambda: truth, clock)

    def after(seconds: float, running: bool = True) -> str:
        clock.advance(seconds)
        return over(running)

    assert [after(1.0), after(1.0)] == ["", ""]
    truth["success"] = True
    assert [after(0.1), after(0.9)] == ["", ""]
    truth["success"] = False
    assert after(0.2) == ""
    truth["success"] = True
    assert [after(0.1), after(5.0, running=False), after(0.1), after(0.9)] == ["", "", "", ""]
    assert after(0.1) == "the simulated bench has said success for 1 s"


def test_a_station_without_a_declared_bench_is_refused(tmp_path: Path) -> None:
    given = [f'data_dir="{tmp_path}"', "transport.simulated=false"]
    with pytest.raises(
        SetupError, match=r"transport.kind = 'zmq' with a bench in lockstep; allowed: zmq with"
    ):
        lockstep.station(DEPLOYMENTS / "tabletop.toml", given, VirtualClock())


def test_the_bench_is_the_one_that_is_asked_for() -> None:
    arguments = [str(DEPLOYMENTS / "tabletop.toml")]
    assert lockstep.parser().parse_args(arguments).bench is None  # then that of the deployment's transport
    assert lockstep.parser().parse_args([*arguments, "--bench", "tabletop"]).bench == "tabletop"
    options = parser().parse_args(
        ["--robot", "ur5e", "--bench", "contact", "--width", "64", "--height", "48"]
    )
    around = make_environment(robots.load_robot("ur5e"), options)
    assert isinstance(around, BenchEnvironment)
    assert isinstance(around._tabletop, ContactTabletop)


PIPER = robots.load_robot("agilex_piper")
PARTS = {group.name: list(range(group.slice.start, group.slice.stop)) for group in PIPER.groups}
VIEWS = {camera.key: camera.key for camera in PIPER.cameras}
WIRES: dict[str, dict[str, Any]] = {
    "openpi": {},
    "gr00t": {"dialect": "nested", "video": VIEWS, "state": PARTS, "actions": PARTS},
    "lerobot": {"accept_pickle": True, "policy_type": "act", "checkpoint": "user/ckpt", "images": VIEWS},
}


@pytest.mark.some(1)
@pytest.mark.parametrize("protocol", WIRES)
def test_a_server_of_any_protocol_drives_the_bench_and_its_delay_is_the_stations(
    protocol: str, tmp_path: Path
) -> None:
    clock = VirtualClock()
    line = f"{protocol} --robot agilex_piper --behaviour pick_place --port 0"
    server = serve.build_server(serve.parser().parse_args(shlex.split(line)), clock)
    with closing(server):
        policy = {"kind": protocol, "url": str(server.start()["url"]), "delay_ms": [70.0, 230.0]}
        given = [f'data_dir="{tmp_path}"', "lease.ttl_s=600", "recording.export=false"]
        station = lockstep.station(
            DEPLOYMENTS / "tabletop.toml", given, clock, "--width", "400", "--height", "300"
        )
        with closing(station):
            operator = Operator(station, 0)
            operator.trial(policy | WIRES[protocol], 4, 20.0)
            (course,) = operator.courses()
    assert course.truth["success"] is True
    assert course.delays == {3, 7}


def test_a_server_that_takes_real_time_is_refused() -> None:
    given = serve.parser().parse_args(["gr00t", "--robot", "agilex_piper", "--latency-ms", "80"])
    with pytest.raises(
        SetupError, match="--latency-ms 80 in lockstep, where real time does not count; allowed"
    ):
        serve.build_server(given, VirtualClock())
