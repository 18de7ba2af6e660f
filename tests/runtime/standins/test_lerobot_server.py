"""The stand-in for LeRobot's policy server: as a process, by its rules, and as the policy of a trial in lockstep."""

from __future__ import annotations

import contextlib
import io
import json
import pickletools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robots
from runtime.core.clock import MonotonicClock
from runtime.core.errors import SetupError
from runtime.core.types import Observation
from runtime.ipc.session_state import SessionState
from runtime.policies import lerobot
from runtime.simulation.scripts.script import Script
from runtime.station.spec import StationSpec
from tests.processes import PATIENCE_S
from tests.runtime.simulation.tabletop_station import HORIZON, pick_and_place, planned

grpc = pytest.importorskip("grpc", reason="the extra lerobot-grpc is not installed")
from runtime.standins import lerobot_wire as wire  # noqa: E402
from runtime.standins.lerobot_server import LerobotBehaviour, LerobotServer  # noqa: E402

VECTORS = Path(__file__).parents[1] / "vectors"
ROBOT = robots.load_robot("ur5e")


class Client:
    """Calls by name; messages are protobuf's own."""

    def __init__(self, url: str) -> None:
        self._channel = grpc.insecure_channel(url.removeprefix("grpc://"))

    def _path(self, name: str) -> str:
        return f"/transport.AsyncInference/{name}"

    def call(self, name: str, message: Any) -> bytes:
        made = self._channel.unary_unary(self._path(name), request_serializer=type(message).SerializeToString)
        return bytes(made(message, timeout=PATIENCE_S))

    def observe(self, data: bytes) -> None:
        message = wire.MESSAGES["Observation"](transfer_state=3, data=data)
        made = self._channel.stream_unary(
            self._path("SendObservations"), request_serializer=type(message).SerializeToString
        )
        made(iter([message]), timeout=PATIENCE_S)

    def act(self) -> bytes:
        return bytes(
            wire.MESSAGES["Actions"].FromString(self.call("GetActions", wire.MESSAGES["Empty"]())).data
        )

    def close(self) -> None:
        self._channel.close()


@contextlib.contextmanager
def served(robot: Any = ROBOT, **behaviour: Any) -> Iterator[tuple[LerobotServer, Client]]:
    behaviour = {"patience": 0.05, **behaviour}
    with contextlib.closing(LerobotServer(robot, LerobotBehaviour(**behaviour))) as server:
        client = Client(str(server.start()["url"]))
        yield server, client
        client.close()


def test_recorded_messages_of_the_real_client_are_understood_and_the_answer_is_nothing_without_a_policy() -> (
    None
):
    observation = (VECTORS / "lerobot_timed_observation.bin").read_bytes()
    with served() as (server, client):
        client.call("Ready", wire.MESSAGES["Empty"]())
        assert client.act() == b""
        client.observe(observation)
        assert client.act() == b""
        assert server.failures == ["RuntimeError: No policy loaded"]
        instructions = (VECTORS / "lerobot_remote_policy_config.bin").read_bytes()
        client.call("SendPolicyInstructions", wire.MESSAGES["PolicySetup"](data=instructions))
        assert server.loads == 1
        client.observe(observation)
        assert client.act() == b""  # of two numbers no script of a robot makes anything
        assert len(server.failures) == 2


def test_a_pickle_that_names_something_else_is_not_read() -> None:
    for data in (wire.command_pickle("true"), b"\x80\x04cos\nsystem\n."):
        with pytest.raises(ModuleNotFoundError, match="No module named"):
            wire.unpickle(data)


def test_its_pickles_name_what_those_of_the_real_server_name() -> None:
    def calls(data: bytes) -> list[Any]:
        """What is named."""
        named, strings = [], []
        for code, argument, _ in pickletools.genops(io.BytesIO(data)):
            strings += [argument] if isinstance(argument, str) else []
            if code.name == "STACK_GLOBAL":
                named.append(" ".join(strings[-2:]))
            elif code.name == "GLOBAL":
                named.append(argument)
        return named

    rows = np.arange(6, dtype=np.float32).reshape(3, 2) / 4
    made = wire.timed_actions(rows, [7, 8, 9], [1700000000.25, 1700000000.2833333, 1700000000.3166666])
    recorded = (VECTORS / "lerobot_timed_actions_views.bin").read_bytes()
    assert set(calls(made)) == set(calls(recorded))


def test_a_port_that_is_taken_is_an_error() -> None:
    with served() as (server, _), pytest.raises(SetupError, match="cannot listen at"):
        LerobotServer(ROBOT, LerobotBehaviour(), server._port).start()


def test_it_skips_what_shows_nothing_new_unless_it_must_go() -> None:
    with served() as (server, _):
        names = {"observation.state": {"names": ["a"]}}
        server._told = type("Told", (), {"lerobot_features": names})

        def shown(timestep: int, angle: float) -> Any:
            return type("Shown", (), {"timestep": timestep, "observation": {"a": angle}})

        server._last, server._predicted = shown(1, 0.0), {1}
        assert not server._is_news(shown(2, 0.5))
        assert server._is_news(shown(2, 1.5))
        assert not server._is_news(shown(1, 1.5))


def test_the_process_serves_the_client(start: Any) -> None:
    url = start(
        "runtime.standins.serve", "lerobot", "--robot", "ur5e", "--port", "0", "--horizon", "20"
    ).ready["url"]
    settings = lerobot.Config(
        url=url, accept_pickle=True, policy_type="act", checkpoint="a", images={"front": "cam_high"}
    )
    shown = Observation(1, 0.0, {}, np.zeros(7, np.float32), {"cam_high": np.zeros((8, 8, 3), np.uint8)})
    with contextlib.closing(lerobot.build(settings, ROBOT, MonotonicClock(), ROBOT.control_rate)) as policy:
        assert policy.infer(shown).actions.shape == (20, 7)


@pytest.mark.exhaustive
def test_a_trial_through_lerobot_puts_the_block_on_the_plate(tmp_path: Path) -> None:
    robot = planned("tabletop_ur5e", tmp_path, None).robot
    cameras = ", ".join(f"{camera.key} = {json.dumps(camera.key)}" for camera in robot.cameras)
    assignments = [
        'policy.kind="lerobot"', 'policy.policy_type="act"', 'policy.checkpoint="stand-in"',
        "policy.accept_pickle=true", f"policy.images={{{cameras}}}",
    ]  # fmt: skip
    servers: list[LerobotServer] = []

    def serve(made: StationSpec, script: Script) -> LerobotServer:
        servers.append(LerobotServer(made.robot, LerobotBehaviour(HORIZON, made.rate), 0, script))
        return servers[0]

    trial = pick_and_place("tabletop_ur5e", 0, tmp_path, assignments, serve)
    assert trial.success, trial.events
    assert trial.state is SessionState.RUNNING
    assert servers[0].failures == []
