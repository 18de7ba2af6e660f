"""Every fault of a policy server against every client: one named error, one helpful sentence, in time."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, ConnectionClosedOK
from websockets.sync.server import ServerConnection

from runtime.core import msgpack_arrays
from runtime.core.errors import (
    ContradictionError,
    PolicyDisconnected,
    PolicyError,
    PolicyLostError,
    PolicyTimeout,
)
from runtime.core.types import Conditioning
from runtime.standins import faults
from runtime.standins.faults import Fault
from tests.conformance.policies_served import PROTOCOLS, WEBSOCKETS, Served, protocol
from tests.processes import PATIENCE_S, eventually, joined
from tests.runtime.policies.peers import seen, serving

DEADLINE = 0.4  # s, where only a deadline ends the waiting; else what is wrong is noticed at once
WAITING = {"mute_on_connect", "mute_on_infer", "late_reply", "request_id"}
Faults = dict[str, tuple[type[PolicyError], str]]

WEBSOCKET: Faults = {
    "mute_on_connect": (PolicyTimeout, "did not send its metadata within"),
    "text_first": (PolicyError, "reports an error: the checkpoint could not be loaded"),
    "http_404": (PolicyError, "HTTP 404"),
    "mute_on_infer:0": (PolicyTimeout, r"within 0\.4 s"),
    "mute_on_infer:1": (PolicyTimeout, r"within 0\.4 s"),
    "close_mid_reply:0": (PolicyDisconnected, "closed the connection"),
    "close_mid_reply:1": (PolicyDisconnected, "closed the connection"),
    "wrong_dim": (PolicyError, "rows of 7 numbers; this robot needs 8"),
    "nan": (PolicyError, "nan at row 3, column 2"),
    "empty": (PolicyError, "actions is empty"),
    "two_batches": (PolicyError, r"shape \[2, .*, 8\]"),
    "bad_array_dialect": (PolicyError, "MNP"),
    "object_array": (PolicyError, "refused"),
    "exception": (PolicyError, "CUDA out of memory"),
    "late_reply:4": (PolicyTimeout, "the connection is dropped"),
    "too_large": (PolicyError, "67108865 bytes exceeds limit of 67108864 bytes"),
}
GR00T: Faults = {
    "mute_on_connect": (PolicyLostError, "did not send an answer to get_modality_config within"),
    "mute_on_infer:0": (PolicyLostError, "did not send an answer to get_action within 0.4 s"),
    "mute_on_infer:1": (PolicyLostError, "did not send an answer to get_action within 0.4 s"),
    "late_reply:4": (PolicyLostError, "the connection is dropped"),
    "close_mid_reply:0": (PolicyLostError, "closed the connection before an answer"),
    "close_mid_reply:1": (PolicyLostError, "closed the connection before an answer"),
    "wrong_dim": (PolicyError, "rows of 6 numbers; this robot needs 7"),
    "nan": (PolicyError, "action 'left_arm' has nan at row 3, column 2"),
    "empty": (PolicyError, "action 'left_arm' is empty"),
    "bad_array_dialect": (PolicyError, "openpi dialect"),
    "object_array": (PolicyError, "not the GR00T protocol: .*objects"),
    "exception": (PolicyError, "CUDA out of memory"),
    "two_batches": (PolicyError, r"shape \[2, 50, 7\]"),
    "unknown_endpoint": (PolicyError, "has no endpoint 'get_modality_config'"),
    "error_bytes": (PolicyError, "answers get_action with ERROR"),
    "malformed": (PolicyError, "not one msgpack message"),
    "two_frames": (PolicyError, "2 frames; expected one"),
    "missing_key": (PolicyError, r"no action 'left_arm'; it has (action\.)?right_arm"),
    "uneven": (PolicyError, "different numbers of rows: left_arm 49, right_arm 50"),
    "too_large": (PolicyDisconnected, "sends no more than 67108864 bytes"),
}
STARVLA = {key: value for key, value in WEBSOCKET.items() if key != "exception"} | {
    "refused": (PolicyError, "CUDA out of memory"),
    "request_id": (PolicyError, "request"),
}
XPOLICYLAB = {key: value for key, value in WEBSOCKET.items() if key != "two_batches"} | {
    "mute_on_connect": (PolicyTimeout, "did not send an answer to hello within"),
    "wrong_dim": (PolicyError, r"'arm_joint_state' of step 0 has the shape \[6\]; this robot needs \[7\]"),
    "nan": (PolicyError, "action 'arm_joint_state' has nan at row 3, column 2"),
    "two_batches": (PolicyError, "step 0 of actions is a list"),
    "bad_array_dialect": (PolicyError, "openpi dialect"),
    "refused": (PolicyError, "infer_failed: CUDA out of memory"),
    "request_id": (PolicyTimeout, "did not send an answer to infer within"),
    "malformed": (PolicyError, "not the XPolicyLab protocol"),
    "missing_key": (PolicyError, "has no arm_joint_state"),
    "unknown_key": (PolicyError, "the unexpected gripper"),
    "delta_key": (PolicyError, "the unexpected delta_ee_pose"),
}
FAULTS: dict[str, Faults] = {
    "openpi": WEBSOCKET,
    "roboarena": WEBSOCKET,
    "vllm": WEBSOCKET
    | {
        "exception": (PolicyError, "Internal inference error"),
        "not_loaded": (PolicyError, "Robot policy not available"),
    },
    "starvla": STARVLA | {"normalized": (PolicyError, "normali")},
    "starvla-old": STARVLA | {"empty": (PolicyError, "normalized_actions is empty")},
    "xpolicylab": XPOLICYLAB,
    "gr00t-n1.5": {key: value for key, value in GR00T.items() if key != "two_batches"},
    "gr00t-n1.6": GR00T,
    "gr00t-n1.7": GR00T,
    "gr00t-n1.7-early": GR00T,
    "gr00t-starvla": GR00T,
    "lerobot": {
        "mute_on_connect": (PolicyLostError, "did not answer Ready within"),
        "mute_on_infer:0": (PolicyLostError, "did not answer GetActions within"),
        "mute_on_infer:1": (PolicyLostError, "did not answer GetActions within"),
        "late_reply:4": (PolicyLostError, "the connection is dropped"),
        "close_mid_reply:0": (PolicyLostError, "closed the connection"),
        "close_mid_reply:1": (PolicyLostError, "closed the connection"),
        "wrong_dim": (PolicyError, "rows of 13 numbers; this robot needs 14"),
        "nan": (PolicyError, "nan at row 3, column 2"),
        "empty": (PolicyError, "has no actions"),
        "exception": (PolicyError, "answered with nothing"),
        "malformed": (PolicyError, "not LeRobot's"),
        "foreign_name": (PolicyError, r"names os\.system is refused; allowed: "),
        "other_step": (PolicyError, "steps 1001, 1002"),
        "other_rate": (PolicyError, "rows are at 60 Hz"),
        "load_fails": (PolicyError, "not a folder with a config.json"),
        "no_name": (PolicyError, "policy.server_version"),
        "too_large": (PolicyError, r"too large for GetActions: .*larger than max .* vs\. 8388608"),
    },
}
# Faults that a protocol cannot have, or that are none there; each with the reason.
NONE: dict[str, dict[str, str]] = {
    "starvla": {"exception": "its server tells errors of a model as a map: refused"},
    "starvla-old": {"exception": "its server tells errors of a model as a map: refused"},
    "gr00t-n1.5": {"two_batches": "its answers have no batch axis"},
    "lerobot": {
        "bad_array_dialect": "tensors are pickles of torch",
        "object_array": "tensors are pickles of torch",
        "two_batches": "each step has one row",
    },
}
EVERYWHERE = {
    *("mute_on_connect", "mute_on_infer", "close_mid_reply", "late_reply", "wrong_dim", "nan", "empty"),
    *("bad_array_dialect", "object_array", "exception", "two_batches", "too_large"),
}

pytestmark = [
    pytest.mark.usefixtures("no_thread_is_left"),
    pytest.mark.exhaustive,
]  # policies/ has each protocol
on_every_protocol = pytest.mark.parametrize("name", PROTOCOLS)


def fault_of(text: str, served: Served) -> tuple[Fault, float]:
    """The fault, and the deadline under which it is noticed."""
    name, _, argument = text.partition(":")
    if argument and name != "late_reply":
        argument = str(int(argument) + served.first)
    return Fault(name, argument), DEADLINE if name in WAITING else PATIENCE_S


@pytest.mark.parametrize(("name", "fault"), [(name, fault) for name in FAULTS for fault in FAULTS[name]])
def test_a_fault_is_one_named_error_and_one_helpful_sentence_in_time(
    name: str, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asked three times: before it comes to the fault, and after it, when the next request is one of its own."""
    monkeypatch.chdir(tmp_path)  # where a command that is run would leave its trace
    served, (error, says) = protocol(name), FAULTS[name][fault]
    played, deadline = fault_of(fault, served)
    if (name, fault) == ("lerobot", "exception"):
        deadline = DEADLINE  # it answers with nothing until then
    deadlines = dict.fromkeys(
        ("first_inference_deadline", "inference_deadline", "connect_deadline"), deadline
    )
    told: list[PolicyError] = []
    with served.served(played, **deadlines) as policy:
        for _ in range(3):
            began = time.monotonic()
            try:
                policy.infer(seen(served.robot))
            except PolicyError as failure:
                told.append(failure)
            assert time.monotonic() - began < PATIENCE_S, "it hung"
    assert told, "the fault was not noticed"
    assert (error is PolicyError) != isinstance(told[0], PolicyLostError)
    with pytest.raises(error, match=says):
        raise told[0]
    assert list(tmp_path.iterdir()) == []


def test_every_protocol_plays_every_fault_or_says_why_it_cannot() -> None:
    assert set(FAULTS) == set(PROTOCOLS)
    for name, table in FAULTS.items():
        names = {fault.partition(":")[0] for fault in table}
        assert EVERYWHERE - names == set(NONE.get(name, {}))
        assert names <= set(faults.NAMES)
    assert {"text_first", "http_404"} <= set(WEBSOCKET)


@pytest.mark.parametrize("name", [name for name in WEBSOCKETS if name != "xpolicylab"])
@pytest.mark.parametrize(("fault", "rows"), [("batched", None), ("single_row", 1)])
def test_one_batch_and_one_row_are_understood(name: str, fault: str, rows: int | None) -> None:
    """Rows of the other protocols come in one form."""
    served = protocol(name)
    with served.served(Fault(fault)) as policy:
        actions = policy.infer(seen(served.robot)).actions
    assert actions.shape[1] == served.robot.dim
    assert rows is None or len(actions) == rows


@on_every_protocol
def test_a_late_answer_is_never_paired_with_the_next_request(name: str) -> None:
    served = protocol(name)
    deadlines = {"first_inference_deadline": 10.0, "inference_deadline": 0.4}
    with served.served(Fault("late_reply", "4"), **deadlines) as policy:
        if not served.first:  # else its second request is the first for rows, which may take long
            assert served.begins_at(policy, 0.05)
            with pytest.raises(PolicyTimeout):
                policy.infer(seen(served.robot, 0.5))
        answered = 0
        while answered < 3:
            value = 0.1 * (answered + 1)
            with contextlib.suppress(PolicyLostError):  # the server may still be at what nobody waits for
                assert served.begins_at(policy, value)
                answered += 1


@pytest.mark.parametrize("fault", ["doubled:2", "doubled_late:2", "doubled:3", "doubled_late:3"])
@pytest.mark.parametrize("name", WEBSOCKETS)
def test_a_doubled_answer_is_never_paired_with_another_question(name: str, fault: str) -> None:
    """It costs at most one question; before, all later answers were off by one for good.

    A REP socket and a call of gRPC have one answer; one that a proxy repeats to GR00T: test_gr00t.py.
    """
    served = protocol(name)
    failed = 0
    with served.served(Fault(*fault.split(":"))) as policy:
        for number in range(8):
            try:
                assert served.begins_at(policy, 0.1 + 0.1 * number)
            except PolicyError:
                failed += 1
    assert failed <= 1


@on_every_protocol
def test_a_reset_while_an_answer_is_in_flight_leaves_both_right(name: str) -> None:
    served = protocol(name)
    with served.served() as policy:
        policy.connect()
        policy.infer(seen(served.robot))
        found: list[bool] = []
        asking = threading.Thread(target=lambda: found.append(served.begins_at(policy, 0.4)))
        asking.start()
        with contextlib.suppress(PolicyLostError):
            policy.reset()
        joined(asking)
        assert found == [True]
        assert served.begins_at(policy, 0.2)


@on_every_protocol
def test_closing_frees_whoever_waits_and_may_be_done_twice(name: str) -> None:
    served = protocol(name)
    with served.served(
        Fault("mute_on_infer", str(served.first + 1)), inference_deadline=PATIENCE_S
    ) as policy:
        assert served.begins_at(policy, 0.1)
        failed: list[Exception] = []

        def wait() -> None:
            try:
                policy.infer(seen(served.robot))
            except PolicyError as error:
                failed.append(error)

        waiting = threading.Thread(target=wait)
        waiting.start()
        waiting.join(0.1)
        policy.close()
        policy.close()
        joined(waiting)
        assert len(failed) == 1
        with pytest.raises(PolicyError, match="closed"):
            raise failed[0]


@on_every_protocol
def test_a_port_where_nobody_listens_is_said_to_be_empty(name: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    served = protocol(name)
    with (
        served.policy(f"{served.scheme}://127.0.0.1:{port}") as policy,
        pytest.raises(PolicyLostError, match=r"no policy server listens .*policy\.url"),
    ):
        policy.connect()


@pytest.mark.parametrize("end", ["closed", "connected anew", "refused"])
def test_a_server_is_left_with_a_close_frame(end: str) -> None:
    """Else a server that reads until its client is gone ends in a traceback."""
    ended: list[ConnectionClosed] = []

    def converse(connection: ServerConnection) -> None:
        connection.send(msgpack_arrays.pack({"action_dim": 99} if end == "refused" else {}))
        try:
            while True:
                connection.recv()
        except ConnectionClosed as closed:
            ended.append(closed)

    with serving(converse) as url, protocol("openpi").policy(url) as policy:
        with contextlib.suppress(ContradictionError):
            policy.connect()
        if end == "connected anew":
            policy.connect()
        if end == "closed":
            policy.close()
        eventually(lambda: ended, "the end of the first conversation")
    assert isinstance(ended[0], ConnectionClosedOK), ended[0]


@on_every_protocol
def test_a_port_that_says_nothing_times_out(name: str) -> None:
    served = protocol(name)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"{served.scheme}://127.0.0.1:{listener.getsockname()[1]}"
        with (
            served.policy(url, connect_deadline=DEADLINE) as policy,
            pytest.raises(PolicyLostError, match=r"within 0\.[0-9]+ s"),
        ):
            policy.connect()


@pytest.mark.parametrize("name", ["gr00t-n1.6", "lerobot", "starvla", "roboarena", "xpolicylab"])
def test_conditioning_is_refused_where_the_server_would_not_know_it(name: str) -> None:
    served = protocol(name)
    given = Conditioning(np.zeros((3, served.robot.dim), np.float32), 1, 1, 3)
    with (
        served.policy(f"{served.scheme}://127.0.0.1:1") as policy,
        pytest.raises(PolicyError, match="no real-time chunking"),
    ):
        policy.infer(seen(served.robot), given)


@pytest.mark.parametrize("name", WEBSOCKETS)
def test_two_clients_at_one_server_get_their_own_answers(name: str) -> None:
    """GR00T's and LeRobot's servers have one client at a time."""
    served = protocol(name)
    with contextlib.closing(served.server(faults.NONE)) as server:
        url = str(server.start()["url"])
        with served.policy(url) as one, served.policy(url) as other:
            for value in (0.1, 0.3):
                assert served.begins_at(one, value)
                assert served.begins_at(other, value + 0.1)


@pytest.mark.parametrize(
    "server", ["openpi", "roboarena", "vllm", "starvla", "xpolicylab", "gr00t-n1.6", "lerobot"]
)
@on_every_protocol
def test_a_server_of_another_protocol_is_named_or_refuses_to_answer(name: str, server: str) -> None:
    """No client takes rows from a server that it does not understand."""
    served, other = protocol(name), protocol(server)
    if served.kind == other.kind:
        return
    deadlines = {"connect_deadline": 1.0, "first_inference_deadline": 1.0}
    with contextlib.closing(other.server(faults.NONE)) as made:
        place = str(made.start()["url"]).partition("://")[2]
        url = place if served.scheme == "ws" else place.partition("/")[0]  # of which others have no path
        with (
            served.policy(f"{served.scheme}://{url}", **deadlines) as policy,
            pytest.raises(PolicyError) as raised,
        ):
            policy.infer(seen(served.robot))
    assert len(str(raised.value)) > 40


@pytest.mark.parametrize("name", ["openpi", "roboarena", "vllm"])
def test_a_contradiction_about_the_action_space_is_found_at_set_up(name: str) -> None:
    with (
        protocol(name).served(Fault("action_mode", "torque")) as policy,
        pytest.raises(PolicyError, match="torque"),
    ):
        policy.connect()


def test_a_server_of_velocities_contradicts_a_deployment_of_positions() -> None:
    with (
        protocol("roboarena").served(Fault("action_mode", "joint_velocity")) as policy,
        pytest.raises(ContradictionError, match="joint_velocity"),
    ):
        policy.connect()
