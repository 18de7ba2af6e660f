"""The stand-in GR00T server: as a process, and as the policy of a trial in lockstep."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

import robots
from runtime.config.loader import load
from runtime.core.clock import MonotonicClock
from runtime.core.types import Observation
from runtime.ipc.session_state import SessionState
from runtime.policies import gr00t
from runtime.simulation.scripts.script import Script
from runtime.standins.gr00t_server import Gr00tBehaviour, Gr00tServer
from runtime.station.spec import StationSpec
from tests.processes import PATIENCE_MS
from tests.runtime.simulation.tabletop_station import HORIZON, pick_and_place, planned

ROOT = Path(__file__).parents[3]
VECTORS = Path(__file__).parents[1] / "vectors"


@pytest.fixture
def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def asked(url: str, message: object) -> Any:
    wire: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REQ)
    try:
        wire.connect(url)
        wire.send(message if isinstance(message, bytes) else msgpack.packb(message))
        assert wire.poll(PATIENCE_MS)
        return wire.recv()
    finally:
        wire.close(linger=0)


def test_the_process_answers_as_the_real_server_does(start: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LAB_TOKEN", "secret")
    line = ["gr00t", "--robot", "ur5e", "--port", "0", "--version", "n1.7", "--token-env", "LAB_TOKEN"]
    url = start("runtime.standins.serve", *line).ready["url"]
    known = {"api_token": "secret"}
    assert asked(url, {"endpoint": "ping", **known}) == bytes.fromhex(
        "82a6737461747573a26f6ba76d657373616765b15365727665722069732072756e6e696e67"
    )
    assert asked(url, {"endpoint": "reset", "data": {"options": None}, **known}) == b"\x80"
    configuration = msgpack.unpackb(asked(url, {"endpoint": "get_modality_config", **known}))
    assert configuration["state"]["__ModalityConfig__"] is True
    assert configuration["state"]["as_json"]["modality_keys"] == ["arm"]
    assert msgpack.unpackb(asked(url, {"endpoint": "ping"})) == {"error": "Unauthorized: Invalid API token"}
    assert msgpack.unpackb(asked(url, {"endpoint": "fly", **known})) == {"error": "Unknown endpoint: fly"}
    foreign = (VECTORS / "gr00t_n16_get_action_request.bin").read_bytes()
    assert msgpack.unpackb(asked(url, foreign)) == {"error": "Unauthorized: Invalid API token"}


def toml(table: dict[str, Any]) -> str:
    return "{" + ", ".join(f"{key} = {json.dumps(value)}" for key, value in table.items()) + "}"


@pytest.mark.exhaustive
@pytest.mark.parametrize("version", ["n1.7-early", "starvla"])
def test_a_trial_through_gr00t_puts_the_block_on_the_plate(tmp_path: Path, version: Any) -> None:
    robot = planned("tabletop_ur5e", tmp_path, None).robot
    groups = toml({group.name: list(range(group.slice.start, group.slice.stop)) for group in robot.groups})
    cameras = toml({camera.key: camera.key for camera in robot.cameras})
    assignments = [
        'policy.kind="gr00t"', 
        f"policy.video={cameras}", f"policy.state={groups}", f"policy.actions={groups}",
    ]  # fmt: skip
    servers: list[Gr00tServer] = []

    def serve(made: StationSpec, script: Script) -> Gr00tServer:
        servers.append(Gr00tServer(made.robot, Gr00tBehaviour(version, False, HORIZON, made.rate), 0, script))
        return servers[0]

    trial = pick_and_place("tabletop_ur5e", 0, tmp_path, assignments, serve)
    assert trial.success, trial.events
    assert trial.state is SessionState.RUNNING
    assert servers[0].failures == []


def test_the_deployment_of_the_document_is_answered_by_the_stand_in_that_it_names() -> None:
    resolved = load(ROOT / "deployments" / "gr00t.toml")
    settings, robot = resolved.deployment.policy, robots.load_robot(resolved.deployment.robot)
    server = Gr00tServer(robot, Gr00tBehaviour("n1.7"))
    with contextlib.closing(server):
        here = settings.model_copy(update={"url": server.start()["url"]})
        pictures = {camera.key: np.zeros((8, 8, 3), np.uint8) for camera in robot.cameras}
        shown = Observation(1, 0.0, {}, robot.poses["home"].astype(np.float32), pictures)
        with contextlib.closing(gr00t.build(here, robot, MonotonicClock(), 30.0)) as policy:
            policy.connect()
            assert policy.infer(shown).actions.shape == (50, robot.dim)
    assert server.failures == []


def test_the_server_of_the_document_is_one(free_port: int) -> None:
    document = (ROOT / "docs" / "policies.md").read_text("utf-8")
    section = document.partition("\n## GR00T\n")[2].partition("\n## ")[0]
    code = section.partition("```python\n")[2].partition("```")[0].replace(":5555", f":{free_port}")
    assert len(code.splitlines()) <= 34
    with subprocess.Popen([sys.executable, "-c", code]) as process:
        try:
            url = f"tcp://127.0.0.1:{free_port}"
            assert set(msgpack.unpackb(asked(url, {"endpoint": "get_modality_config"}))) >= {
                "video",
                "action",
            }
            robot = robots.load_robot("ur5e")
            settings = gr00t.Config(
                url=url,
                video={"ego_view": "cam_high"},
                state={"arm": [*range(7)]},
                actions={"arm": [*range(7)]},
            )
            joints = np.linspace(0.0, 0.6, 7, dtype=np.float32)
            shown = Observation(1, 0.0, {}, joints, {"cam_high": np.zeros((8, 8, 3), np.uint8)})
            with contextlib.closing(gr00t.build(settings, robot, MonotonicClock(), 25.0)) as policy:
                np.testing.assert_array_equal(policy.infer(shown).actions, np.tile(joints, (16, 1)))
        finally:
            process.terminate()
