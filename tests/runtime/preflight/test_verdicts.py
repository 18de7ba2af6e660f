"""Every fault of every stand-in is one verdict, found in one stage."""

from __future__ import annotations

import socket
import threading
from http import HTTPStatus
from typing import Any

import pytest
from websockets.sync.server import serve

from runtime.core.errors import PolicyError, PolicyLostError, RuntimeFault, SetupError
from runtime.preflight.runner import PreflightRunner
from runtime.preflight.verdict import PreflightStage, PreflightVerdict, stage_of, verdict_of
from runtime.standins.gr00t_server import Gr00tBehaviour, Gr00tServer
from tests.runtime.policies.peers import PIPER
from tests.runtime.preflight.bench import HURRIED, WIRES, flown, planned, served

WEBSOCKETS = ("openpi", "roboarena", "vllm", "starvla", "xpolicylab")
GROOTS = ("gr00t-n1.5", "gr00t-n1.6")
WAITING = ("mute_on_connect", "mute_on_infer", "late_reply", "request_id")  # faults that only a deadline ends

EVERYWHERE = {
    "mute_on_connect": ("timeout", "protocol"),
    "mute_on_infer:0": ("timeout", "infer"),
    "mute_on_infer:1": ("timeout", "infer"),
    "late_reply:4": ("timeout", "infer"),
    "close_mid_reply:0": ("server_error", "infer"),
    "close_mid_reply:1": ("server_error", "infer"),
    "wrong_dim": ("bad_shape", "shape"),
    "empty": ("bad_shape", "shape"),
    "nan": ("not_finite", "shape"),
}
ON_WEBSOCKETS = {
    "text_first": ("server_error", "protocol"),
    "http_404": ("wrong_protocol", "protocol"),
    "two_batches": ("bad_shape", "shape"),
    "bad_array_dialect": ("wrong_protocol", "infer"),
    "object_array": ("wrong_protocol", "infer"),
}
OF_GROOT = {
    "bad_array_dialect": ("wrong_protocol", "infer"),
    "object_array": ("wrong_protocol", "infer"),
    "exception": ("server_error", "infer"),
    "unknown_endpoint": ("wrong_protocol", "protocol"),
    "error_bytes": ("server_error", "infer"),
    "malformed": ("wrong_protocol", "infer"),
    "two_frames": ("wrong_protocol", "infer"),
    "missing_key": ("bad_shape", "shape"),
    "uneven": ("bad_shape", "shape"),
}
OWN = {
    "openpi": {
        "exception": ("server_error", "infer"),
        "action_mode:torque": ("wrong_action_space", "metadata"),
        "action_mode:eef": ("wrong_action_space", "metadata"),
    },
    "roboarena": {
        "exception": ("server_error", "infer"),
        "action_mode:torque": ("wrong_action_space", "metadata"),
        "action_mode:joint_velocity": ("wrong_action_space", "metadata"),
        "not_loaded": ("server_error", "protocol"),
        "reset_text": ("server_error", "infer"),
    },
    "vllm": {
        "exception": ("server_error", "infer"),
        "action_mode:torque": ("wrong_action_space", "metadata"),
        "not_loaded": ("server_error", "protocol"),
        "reset_text": ("wrong_protocol", "infer"),
    },
    "starvla": {
        "exception": ("server_error", "protocol"),  # of the ping already
        "request_id": ("wrong_protocol", "infer"),
        "normalized": ("wrong_action_space", "space"),
        "refused": ("server_error", "infer"),
    },
    "xpolicylab": {
        "exception": ("server_error", "protocol"),  # of the hello already
        "refused": ("server_error", "infer"),
        "malformed": ("wrong_protocol", "infer"),
        "missing_key": ("bad_shape", "shape"),
        "unknown_key": ("bad_shape", "shape"),
        "delta_key": ("wrong_action_space", "space"),
        "request_id": ("timeout", "infer"),
    },
    "lerobot": {
        "exception": ("server_error", "infer"),
        "malformed": ("wrong_protocol", "infer"),
        "foreign_name": ("wrong_protocol", "infer"),
        "other_step": ("wrong_protocol", "infer"),
        "other_rate": ("contradiction", "space"),
        "load_fails": ("server_error", "protocol"),
        "no_name": ("server_error", "protocol"),
    },
}


def faults_of(name: str) -> dict[str, tuple[str, str]]:
    """The faults that mean something to a wire, and what a preflight finds."""
    found = dict(EVERYWHERE)
    if name in WEBSOCKETS:
        found |= ON_WEBSOCKETS
    if name in GROOTS:
        found |= OF_GROOT
    before = {"starvla": 1, "xpolicylab": 2}.get(name, 0)  # a ping; a hello and a reset
    if before:
        found = {
            key.replace(":1", f":{1 + before}").replace(":0", f":{before}"): what
            for key, what in found.items()
            if key != "late_reply:4"
        }
    return found | OWN.get(name, {})


OTHER_VERSIONS = ("starvla-old", "gr00t-n1.7-early", "gr00t-starvla")  # whose faults tests/conformance has
CASES = [
    pytest.param(name, fault, *what, id=f"{name}-{fault}")
    for name in WIRES
    if name not in OTHER_VERSIONS
    for fault, what in faults_of(name).items()
]


@pytest.mark.some(24)
@pytest.mark.parametrize(("name", "fault", "verdict", "stage"), CASES)
def test_a_fault_is_one_verdict_found_in_one_stage(name: str, fault: str, verdict: str, stage: str) -> None:
    waits = fault.partition(":")[0] in WAITING or (name, fault) == ("lerobot", "exception")
    report = flown(name, fault, **(HURRIED if waits else {}))
    assert (report.verdict, report.stage) == (verdict, stage), report.sentence
    assert not report.ok
    assert len(report.sentence) > 20
    assert report.advice == report.verdict.advice != ""


@pytest.mark.some(7)
@pytest.mark.parametrize("name", WIRES)
def test_a_server_that_is_well_is_shown_with_its_figures(name: str) -> None:
    report = flown(name)
    assert (report.verdict, report.stage, report.advice) == ("ok", "space", ""), report.sentence
    assert [call.name for call in report.calls] == ["connect", "reset", "infer", "infer", "reset"]
    assert all(call.ok and call.ms >= 0 for call in report.calls)
    assert report.chunk is not None
    assert (report.chunk.width, report.chunk.joints) == (WIRES[name].robot.dim,) * 2
    assert report.chunk.rows > 1
    assert report.warm_up_ms is not None
    assert report.latency_ms is not None
    assert report.endpoint.rpartition(":")[0]
    assert report.name
    assert report.metadata


@pytest.mark.parametrize("name", WIRES)
def test_a_closed_port_and_a_host_that_is_not_known_are_told_apart(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    scheme = {"gr00t": "tcp", "lerobot": "grpc"}.get(WIRES[name].settings["kind"], "ws")
    closed = PreflightRunner(planned(WIRES[name], f"{scheme}://127.0.0.1:{port}")).run(60.0)
    assert (closed.verdict, closed.stage) == ("port_closed", "connect"), closed.sentence

    def unknown(*given: object, **options: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    url = f"{scheme}://localhost:{port}"
    report = PreflightRunner(planned(WIRES[name], url)).run(60.0)
    assert (report.verdict, report.stage) == ("unreachable", "connect"), report.sentence
    assert url in report.sentence


@pytest.mark.parametrize("name", WEBSOCKETS)
def test_tls_against_a_server_without_is_tls(name: str) -> None:
    with served(name) as url:
        report = PreflightRunner(planned(WIRES[name], url.replace("ws://", "wss://"))).run(60.0)
    assert (report.verdict, report.stage) == ("tls", "connect"), report.sentence


@pytest.mark.parametrize("status", [HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN])
def test_a_server_that_wants_a_key_refuses(status: HTTPStatus) -> None:
    def refuse(connection: Any, request: Any) -> Any:
        return connection.respond(status, "no key\n")

    with serve(lambda connection: None, "127.0.0.1", 0, process_request=refuse) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        url = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        report = PreflightRunner(planned(WIRES["openpi"], url)).run(60.0)
        server.shutdown()
        thread.join()
    assert (report.verdict, report.stage) == ("refused", "protocol"), report.sentence
    assert "api_key_env" in report.sentence


def test_a_gr00t_server_that_wants_a_token_refuses() -> None:
    server = Gr00tServer(PIPER, Gr00tBehaviour("n1.6", token="secret"))
    try:
        report = PreflightRunner(planned(WIRES["gr00t-n1.6"], str(server.start()["url"]))).run(60.0)
    finally:
        server.close()
    assert (report.verdict, report.stage) == ("refused", "protocol"), report.sentence
    assert "secret" not in str(report.to_dict())


@pytest.mark.parametrize("server", ["openpi", "roboarena", "starvla", "xpolicylab", "gr00t-n1.6"])
@pytest.mark.parametrize("client", ["openpi", "roboarena", "starvla", "xpolicylab", "gr00t-n1.6", "lerobot"])
def test_the_server_of_another_protocol_is_never_taken_for_well(client: str, server: str) -> None:
    if client == server:
        return
    if client == "lerobot":
        pytest.importorskip("grpc", reason="the extra lerobot-grpc is not installed")
    scheme = {"gr00t": "tcp", "lerobot": "grpc"}.get(WIRES[client].settings["kind"], "ws")
    with served(server) as url:
        place = url.partition("://")[2].partition("/")[0]
        report = PreflightRunner(planned(WIRES[client], f"{scheme}://{place}", HURRIED)).run(60.0)
    assert report.verdict in ("wrong_protocol", "timeout", "server_error"), report.sentence
    same_wire = client in WEBSOCKETS and server in WEBSOCKETS
    if not same_wire:
        assert report.stage == "protocol"


@pytest.mark.parametrize(
    ("error", "verdict"),
    [
        (PolicyLostError("gone"), "server_error"),
        (SetupError("the strategy"), "contradiction"),
        (PolicyError("the policy's own code failed"), "failed"),
        (RuntimeFault("anything"), "failed"),
    ],
)
def test_an_error_without_a_class_of_its_own_has_a_verdict_too(error: RuntimeFault, verdict: str) -> None:
    assert verdict_of(error) == verdict


def test_every_verdict_but_ok_says_what_to_do() -> None:
    assert {verdict for verdict in PreflightVerdict if not verdict.advice} == {PreflightVerdict.OK}


@pytest.mark.parametrize("call", ["connect", "infer", "reset", ""])
def test_every_verdict_has_its_stage_whatever_was_under_way(call: str) -> None:
    for verdict in PreflightVerdict:
        assert stage_of(verdict, call) in PreflightStage
    assert stage_of(PreflightVerdict.MISCONFIGURED, call) is PreflightStage.RESOLVE
