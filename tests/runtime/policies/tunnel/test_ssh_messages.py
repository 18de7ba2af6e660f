"""What ssh says, recorded, and what becomes of it."""

from __future__ import annotations

import pytest

from runtime.policies.tunnel.ssh_messages import explain_exit, port_was_taken

# Of OpenSSH 9.2.
DENIED = [
    "Warning: Identity file /k not accessible: No such file or directory.",
    "lab@gpu: Permission denied (publickey).",
]
UNKNOWN = [
    "No ED25519 host key is known for [gpu]:40322 and you have requested strict checking.",
    "Host key verification failed.",
]
CHANGED = [
    "@    WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED!     @",
    "Host key for [gpu]:40322 has changed and you have requested strict checking.",
    "Host key verification failed.",
]
TAKEN = [
    "bind [127.0.0.1]:40999: Address already in use",
    "channel_setup_fwd_listener_tcpip: cannot listen to port: 40999",
    "Could not request local forwarding.",
]


@pytest.mark.parametrize(
    ("said", "sentence", "advice"),
    [
        (
            DENIED,
            "Identity file /k not accessible: No such file or directory.; lab@gpu: Permission denied",
            "agent",
        ),
        (UNKNOWN, "No ED25519 host key is known for [gpu]:40322", 'host_keys = "accept-new"'),
        (CHANGED, "Host key for [gpu]:40322 has changed", "ask who runs that host"),
        (
            ["ssh: connect to host gpu port 22: Connection refused"],
            "connect to host gpu port 22",
            "policy.tunnel.host",
        ),
        (
            ["ssh: Could not resolve hostname gpu: Name or service not known"],
            "Could not resolve",
            "policy.tunnel.host",
        ),
        (["ssh: connect to host gpu port 22: Connection timed out"], "timed out", "policy.tunnel.host"),
        (["Timeout, server gpu not responding."], "Timeout, server gpu not responding.", ""),
        (["Connection to gpu closed by remote host."], "Connection to gpu closed by remote host.", ""),
        ([], "ssh exited with 255 and no output", ""),
    ],
)
def test_the_last_that_was_said_comes_with_what_to_do(said: list[str], sentence: str, advice: str) -> None:
    told = explain_exit(said, 255)
    assert sentence in told
    assert advice in told
    if said:
        assert said[-1] in told


def test_what_ended_at_the_far_end_is_told_from_what_ssh_could_not() -> None:
    told = explain_exit(["This account is currently not available."], 1)
    assert told.startswith("This account is currently not available.: what is run there")
    assert "policy.tunnel.session = false" in told
    assert explain_exit([], -15) == "ssh exited with -15 and no output"
    assert "policy.tunnel.session" in explain_exit([], 0)


def test_a_changed_key_is_never_advised_to_be_accepted() -> None:
    assert "accept-new" not in explain_exit(CHANGED, 255)


def test_a_port_that_is_taken_is_told_from_all_else() -> None:
    assert port_was_taken(TAKEN)
    assert port_was_taken(TAKEN[1:])
    assert not any(port_was_taken(said) for said in (DENIED, UNKNOWN, CHANGED, []))
