"""Which policies get a tunnel, and what is refused before anything is started."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from runtime.config import loader
from runtime.core.clock import MonotonicClock
from runtime.core.errors import ConfigurationError, PolicyError
from runtime.policies.base import Policy
from runtime.policies.openpi import OpenpiPolicy
from runtime.policies.tunnel import policy as tunnelled
from runtime.policies.tunnel.policy import TunnelledPolicy
from runtime.processes.coordinator.builders import make_policy
from runtime.station.checks import check_deployment
from tests.runtime.policies.peers import PIPER, seen

CAMERAS = {camera.key: camera.key for camera in PIPER.cameras}
LEROBOT = {
    "kind": "lerobot",
    "accept_pickle": True,
    "policy_type": "act",
    "checkpoint": "lab/x",
    "images": CAMERAS,
}


@pytest.fixture(autouse=True)
def ssh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An ssh that nobody starts."""
    program = tmp_path / "bin" / "ssh"
    program.parent.mkdir()
    program.write_text("#!/bin/false\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent))
    monkeypatch.setattr(tunnelled, "Ssh", None)


def made(**policy: Any) -> Policy:
    tree = {"station": "bench", "robot": "agilex_piper", "transport": {"kind": "zmq"}, "policy": policy}
    return make_policy(check_deployment(loader.resolve_deployment(tree, {}, "a test")), MonotonicClock())


def test_only_those_that_say_so_have_one() -> None:
    assert isinstance(made(kind="openpi"), OpenpiPolicy)
    policy = made(kind="openpi", observation_space="eef", observation_eef="fk", tunnel={"host": "gpu"})
    assert isinstance(policy, TunnelledPolicy)
    assert (policy.uses_poses, policy.observation_eef) == (True, "fk")
    policy.close()


def test_before_it_is_connected_nothing_goes_anywhere() -> None:
    policy = made(kind="openpi", tunnel={"host": "gpu"})
    with pytest.raises(PolicyError, match="there is no tunnel to gpu; connect first"):
        policy.infer(seen(PIPER))
    policy.reset()


def test_a_checkpoint_lays_its_tunnel_on_top_of_the_deployments_or_takes_it_away() -> None:
    tree = {
        "station": "bench",
        "robot": "agilex_piper",
        "transport": {"kind": "zmq"},
        "policy": {"kind": "openpi", "tunnel": {"host": "gpu", "user": "lab"}},
    }
    resolved = loader.resolve_deployment(tree, {}, "a test")

    def changed(tunnel: object) -> Any:
        other = loader.apply_changes(resolved, {"policy": {"tunnel": tunnel}}, "setup")
        return other.deployment.policy.tunnel  # type: ignore[attr-defined]

    assert changed({"host": "gpu-2"}).where == "lab@gpu-2"
    assert changed(None) is None


@pytest.mark.parametrize("kind", ["mock", "replay"])
def test_policies_without_a_server_have_none(kind: str) -> None:
    with pytest.raises(ConfigurationError, match=r"policy\.tunnel = .*unknown key"):
        made(kind=kind, tunnel={"host": "gpu"})


def test_without_ssh_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(ConfigurationError, match="apt-get install openssh-client"):
        made(kind="openpi", tunnel={"host": "gpu"})


def test_a_url_that_leads_nowhere_is_refused_at_once() -> None:
    with pytest.raises(ConfigurationError, match=r"policy\.url = 'ws://a,b:1'.*policy\.tunnel\.host"):
        made(kind="openpi", url="ws://a,b:1", tunnel={"host": "gpu"})


def test_pickles_go_to_the_far_ends_own_loopback_and_no_farther() -> None:
    pytest.importorskip("grpc", reason="the extra lerobot-grpc is not installed")
    assert isinstance(made(**LEROBOT, tunnel={"host": "gpu"}), TunnelledPolicy)
    beyond = {**LEROBOT, "url": "grpc://10.0.0.7:8080"}
    with pytest.raises(ConfigurationError, match=r"leaves the tunnel's far end lab@gpu over a plain link"):
        made(**beyond, tunnel={"host": "gpu", "user": "lab"})
    with pytest.raises(ConfigurationError, match=r"leaves this machine .*\[policy\.tunnel\]"):
        made(**beyond)
    assert isinstance(made(**beyond, insecure_link=True, tunnel={"host": "gpu"}), TunnelledPolicy)
