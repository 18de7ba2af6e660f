"""Policies through a real tunnel: OpenSSH on both sides, a stand-in of each protocol beyond it."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from runtime.config import loader
from runtime.core.clock import MonotonicClock
from runtime.core.errors import (
    ConfigurationError,
    PolicyError,
    PolicyLostError,
    PortClosedError,
    TlsError,
    TunnelError,
    UnreachableError,
)
from runtime.core.types import ActionChunk, Conditioning, Observation
from runtime.ipc.session_state import SessionState
from runtime.policies.base import Policy, PolicyInfo
from runtime.policies.tunnel import policy as tunnelled
from runtime.policies.tunnel.policy import TunnelledPolicy
from runtime.policies.tunnel.settings import TunnelSettings
from runtime.policies.tunnel.ssh_process import free_port
from runtime.processes.coordinator.builders import make_policy
from runtime.standins.faults import Fault
from runtime.standins.gr00t_server import Gr00tBehaviour, Gr00tServer
from runtime.standins.openpi_server import Behaviour, OpenpiServer
from runtime.standins.starvla_server import StarvlaBehaviour, StarvlaServer
from runtime.standins.xpolicylab_server import XpolicylabBehaviour, XpolicylabServer
from runtime.station.checks import check_deployment
from tests.processes import PATIENCE_S, alive, eventually, joined
from tests.runtime.policies.peers import PIPER, seen
from tests.runtime.policies.tls import encrypted, self_signed
from tests.runtime.simulation.tabletop_station import pick_and_place, served
from tests.ssh import SshServer, key, required

Begin = Callable[..., SshServer]
CAMERAS = {camera.key: camera.key for camera in PIPER.cameras}


def through(tunnel: dict[str, Any], robot: str = "agilex_piper", **policy: Any) -> TunnelledPolicy:
    """A policy as a station makes it, through a tunnel."""
    tree = {
        "station": "bench",
        "robot": robot,
        "transport": {"kind": "zmq"},
        "policy": {
            "kind": "openpi",
            "tunnel": tunnel,
            "connect_deadline": 30.0,
            "inference_deadline": 30.0,
            **policy,
        },
    }
    made = make_policy(check_deployment(loader.resolve_deployment(tree, {}, "a test")), MonotonicClock())
    assert isinstance(made, TunnelledPolicy)
    return made


@contextlib.contextmanager
def standing(behaviour: Behaviour | None = None) -> Iterator[tuple[OpenpiServer, str]]:
    server = OpenpiServer(PIPER, behaviour or Behaviour())
    with contextlib.closing(server):
        yield server, str(server.start()["url"])


class Unusual(Policy):
    """A policy that differs from the interface in everything that it may say of itself."""

    observation_eef = "fk"
    uses_poses = True
    observe_period_s = 0.5
    uses_images = False
    is_queried = False
    is_person = True

    def __init__(self) -> None:
        self.resumed = 0

    def connect(self) -> PolicyInfo:
        return PolicyInfo("unusual")

    def infer(self, observation: Observation, conditioning: Conditioning | None = None) -> ActionChunk:
        raise NotImplementedError

    def reset(self) -> None: ...

    def resume(self) -> None:
        self.resumed += 1

    def close(self) -> None: ...


def test_what_a_policy_says_of_itself_is_said_through_a_tunnel_too() -> None:
    own = Unusual()
    made = TunnelledPolicy(own, TunnelSettings(host="far"), ("127.0.0.1", 1), "ssh")
    made.resume()

    assert own.resumed == 1
    flags = [name for name, value in vars(Unusual).items() if name[0] != "_" and not callable(value)]
    assert {name: getattr(made, name) for name in flags} == {name: getattr(own, name) for name in flags}
    passed_on = {name for name in vars(Policy) if name[0] != "_"} - {*flags, "address_override"}
    assert passed_on <= set(vars(TunnelledPolicy))


def ssh_of(policy: TunnelledPolicy) -> int:
    """The process of its tunnel."""
    assert policy._keeper is not None
    assert policy._keeper._ssh is not None
    return policy._keeper._ssh.pid


def test_a_policy_is_asked_through_a_tunnel_that_ends_with_it(ssh_server: Begin) -> None:
    server = ssh_server()
    with standing() as (_, url):
        policy = through(server.settings(), url=url, health_path="/healthz")
        assert server.sessions() == []  # made, not started
        assert policy.connect().name == "stand-in"
        assert policy.infer(seen(PIPER)).actions.shape[1] == PIPER.dim
        policy.reset()
        pid, session = ssh_of(policy), server.sessions()
        assert alive(pid)
        assert len(session) == 1
        assert Path(f"/proc/{pid}/comm").read_text() == "ssh\n"
        policy.close()
        eventually(lambda: not alive(pid), "the end of ssh")
        with pytest.raises(PolicyError, match="connect first"):
            policy.infer(seen(PIPER))
        assert policy.connect().name == "stand-in"  # another tunnel
        assert ssh_of(policy) != pid
        policy.close()
        policy.close()


def test_a_second_set_up_replaces_the_tunnel(ssh_server: Begin) -> None:
    with standing() as (_, url), contextlib.closing(through(ssh_server().settings(), url=url)) as policy:
        policy.connect()
        first = ssh_of(policy)
        policy.connect()
        eventually(lambda: not alive(first), "the end of the first ssh")
        assert policy.infer(seen(PIPER)).actions.shape[1] == PIPER.dim


def gr00t(url: str) -> dict[str, Any]:
    groups = {group.name: list(range(group.slice.start, group.slice.stop)) for group in PIPER.groups}
    return {"kind": "gr00t", "url": url, "video": CAMERAS, "state": groups, "actions": groups}


def lerobot_server() -> Any:
    pytest.importorskip("grpc", reason="the extra lerobot-grpc is not installed")
    from runtime.standins.lerobot_server import LerobotBehaviour, LerobotServer

    return LerobotServer(PIPER, LerobotBehaviour())


def lerobot(url: str) -> dict[str, Any]:
    made = {"policy_type": "act", "checkpoint": "user/ckpt", "images": CAMERAS, "accept_pickle": True}
    return {"kind": "lerobot", "url": url, **made}


PROTOCOLS: dict[str, tuple[Callable[[], Any], Callable[[str], dict[str, Any]]]] = {
    "gr00t": (lambda: Gr00tServer(PIPER, Gr00tBehaviour("n1.7", False, 8, 30.0)), gr00t),
    "lerobot": (lerobot_server, lerobot),
    "starvla": (
        lambda: StarvlaServer(PIPER, StarvlaBehaviour(size=(24, 32))),
        lambda url: {"kind": "starvla", "url": url, "cameras": list(CAMERAS)},
    ),
    "xpolicylab": (
        lambda: XpolicylabServer(PIPER, XpolicylabBehaviour()),
        lambda url: {"kind": "xpolicylab", "url": url, "cameras": {"cam_high": "cam_head"}},
    ),
}


@pytest.mark.some(1)
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_every_protocol_goes_through_a_tunnel(protocol: str, ssh_server: Begin) -> None:
    """The server takes no connection but those that come out of the tunnel: its port is seen from there alone."""
    make, settings = PROTOCOLS[protocol]
    server = ssh_server()
    with contextlib.closing(make()) as far:
        url = str(far.start()["url"])
        with contextlib.closing(through(server.settings(), **settings(url))) as policy:
            policy.connect()
            policy.reset()
            assert policy.infer(seen(PIPER)).actions.shape[1] == PIPER.dim
            server.stop()
            with pytest.raises(TunnelError, match=r"the tunnel to .* is down since 0 s: "):
                policy.infer(seen(PIPER))
            server.start()
            eventually(lambda: answered(policy), "an answer through another tunnel")


def answered(policy: Policy) -> bool:
    try:
        return bool(len(policy.infer(seen(PIPER)).actions))
    except PolicyLostError:
        return False


def test_the_name_in_a_certificate_is_that_of_the_url_and_not_of_the_near_end(
    ssh_server: Begin, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    certificate = self_signed(tmp_path)
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate[0]))
    settings = ssh_server().settings()
    with encrypted(certificate) as url:  # of localhost, where the near end is 127.0.0.1
        with contextlib.closing(through(settings, url=url, health_path="/healthz")) as policy:
            assert policy.connect().name == "/lab/policy?model=a"
        other = url.replace("localhost", "127.0.0.1")
        with contextlib.closing(through(settings, url=other)) as policy, pytest.raises(TlsError):
            policy.connect()


@pytest.mark.parametrize("health", [{}, {"health_path": "/healthz"}])
def test_a_far_end_without_a_server_is_told_from_a_tunnel_that_is_down(
    ssh_server: Begin, health: dict[str, str]
) -> None:
    port = free_port()
    policy = through(ssh_server().settings(), url=f"ws://127.0.0.1:{port}", **health)
    with contextlib.closing(policy), pytest.raises(PortClosedError) as raised:
        policy.connect()
    told = str(raised.value)
    assert f"is up, but 127.0.0.1 port {port} was not reached from there" in told
    assert "connect failed: Connection refused" in told
    assert "policy.url" in told
    assert "policy.tunnel.host" not in told


def test_a_server_that_forbids_forwarding_is_said_so(ssh_server: Begin) -> None:
    with standing() as (_, url):
        policy = through(ssh_server(AllowTcpForwarding="no").settings(), url=url)
        with contextlib.closing(policy), pytest.raises(UnreachableError, match="AllowTcpForwarding"):
            policy.connect()


def test_an_account_that_may_run_nothing_is_told_how_and_works_without_a_session(ssh_server: Begin) -> None:
    server = ssh_server(ForceCommand="echo This account is for tunnels. && exit 1")
    with standing() as (_, url):
        told = refused(through(server.settings(), url=url))
        assert "This account is for tunnels.: what is run there, cat, ended" in told
        assert "policy.tunnel.session = false" in told
        with contextlib.closing(through(server.settings(session=False), url=url)) as policy:
            assert policy.connect().name == "stand-in"
            assert policy.infer(seen(PIPER)).actions.shape[1] == PIPER.dim


def test_a_server_that_takes_no_sessions_is_said_so(ssh_server: Begin) -> None:
    told = refused(through(ssh_server(MaxSessions="0").settings()))
    assert "no session was opened there" in told
    assert "policy.tunnel.session = false" in told


def test_a_server_that_fails_behind_a_tunnel_that_holds_says_through_which(ssh_server: Begin) -> None:
    with standing(Behaviour(fault=Fault("close_mid_reply"))) as (_, url):
        policy = through(ssh_server().settings(), url=url)
        with contextlib.closing(policy):
            policy.connect()
            with pytest.raises(PolicyLostError, match=r"closed the connection.*\(through the tunnel to "):
                policy.infer(seen(PIPER))
    with standing(Behaviour(fault=Fault("exception"))) as (_, url):
        policy = through(ssh_server().settings(), url=url)
        with contextlib.closing(policy):
            policy.connect()
            with pytest.raises(PolicyError) as raised:
                policy.infer(seen(PIPER))
        assert "tunnel" not in str(raised.value)  # it has nothing to do with it


def refused(policy: Policy) -> str:
    """Why there is no tunnel; nothing of it is left."""
    with contextlib.closing(policy), pytest.raises(TunnelError) as raised:
        policy.connect()
    eventually(
        lambda: not any(one.name == "tunnel" for one in threading.enumerate()), "the end of the keeper"
    )
    return str(raised.value)


def test_a_wrong_key_is_sshs_own_sentence_and_nobody_goes_on_knocking(
    ssh_server: Begin, tmp_path: Path
) -> None:
    server = ssh_server()
    wrong = key(tmp_path / "wrong")
    told = refused(through(server.settings(identity_file=str(wrong))))
    assert told.startswith(f"there is no tunnel to {server.settings()['user']}@127.0.0.1:{server.port}: ")
    assert "Permission denied (publickey)" in told
    assert "policy.tunnel.user or identity_file" in told
    assert server.log().count("Connection closed by authenticating user") == 1


def test_a_host_that_nobody_knows_is_refused_unless_it_may_be_new(ssh_server: Begin, tmp_path: Path) -> None:
    server = ssh_server()
    empty = tmp_path / "empty"
    empty.write_text("")
    settings = server.settings(known_hosts_file=str(empty))
    told = refused(through(settings))
    assert "host key is known" in told
    assert "Host key verification failed" in told
    assert 'host_keys = "accept-new"' in told
    assert empty.read_text() == ""
    new = tmp_path / "new"
    with standing() as (_, url):
        made = through({**settings, "known_hosts_file": str(new), "host_keys": "accept-new"}, url=url)
        with contextlib.closing(made):
            made.connect()
    assert f"[127.0.0.1]:{server.port}" in new.read_text()


def test_a_host_key_that_has_changed_is_refused_also_where_new_ones_are_not(
    ssh_server: Begin, tmp_path: Path
) -> None:
    server = ssh_server()
    kind, public = key(tmp_path / "other").with_suffix(".pub").read_text().split()[:2]
    server.known_hosts.write_text(f"[127.0.0.1]:{server.port} {kind} {public}\n")
    told = refused(through(server.settings(host_keys="accept-new")))
    assert "has changed" in told
    assert "accept-new" not in told


def test_nothing_at_the_port_and_a_mute_server_are_told_apart() -> None:
    required()
    told = refused(through({"host": "127.0.0.1", "port": free_port(), "ssh_config": "none"}))
    assert "Connection refused: correct policy.tunnel.host or port" in told
    with socket.create_server(("127.0.0.1", 0)) as mute:
        tunnel = {
            "host": "127.0.0.1",
            "port": mute.getsockname()[1],
            "ssh_config": "none",
            "connect_deadline": 1.0,
        }
        told = refused(through(tunnel))
    assert "timed out" in told or "not up within 1 s" in told


def test_a_file_that_is_missing_is_named_before_anything_is_started(
    ssh_server: Begin, tmp_path: Path
) -> None:
    server = ssh_server()
    policy = through(server.settings(identity_file=str(tmp_path / "absent")))
    with (
        contextlib.closing(policy),
        pytest.raises(ConfigurationError, match=r"policy\.tunnel\.identity_file"),
    ):
        policy.connect()
    assert "Connection from" not in server.log()


def test_another_port_is_taken_where_somebody_was_quicker(
    ssh_server: Begin, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as quicker, standing() as (_, url):
        taken = quicker.getsockname()[1]
        ports = iter([taken, taken])
        monkeypatch.setattr(tunnelled, "free_port", lambda: next(ports, None) or free_port())
        with contextlib.closing(through(ssh_server().settings(), url=url)) as policy:
            assert policy.connect().name == "stand-in"
            assert next(ports, None) is None


def test_a_set_up_that_is_cancelled_does_not_wait_for_the_tunnel() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        policy = through({"host": "127.0.0.1", "port": mute.getsockname()[1], "ssh_config": "none"})
        told: list[str] = []

        def connect() -> None:
            try:
                policy.connect()
            except PolicyError as error:
                told.append(str(error))

        waiting = threading.Thread(target=connect)
        waiting.start()
        eventually(lambda: policy._keeper is not None and policy._keeper._ssh is not None, "an ssh")
        pid = ssh_of(policy)
        policy.close()
        joined(waiting)
        assert "closed from our side" in told[0]
        eventually(lambda: not alive(pid), "the end of ssh")


def test_a_host_on_the_way_is_jumped_over(ssh_server: Begin, tmp_path: Path) -> None:
    """What the jump needs comes from ssh's configuration, as does the alias of the host itself."""
    gate, inner = ssh_server(), ssh_server()
    configuration = tmp_path / "config"
    configuration.write_text(
        "".join(
            f"Host {name}\n HostName 127.0.0.1\n Port {one.port}\n IdentityFile {one.identity}\n"
            f" UserKnownHostsFile {one.known_hosts}\n IdentitiesOnly yes\n"
            for name, one in (("gate", gate), ("gpu_box", inner))
        )
    )
    tunnel = {"host": "gpu_box", "jump": ["gate"], "ssh_config": str(configuration)}
    with standing() as (_, url), contextlib.closing(through(tunnel, url=url)) as policy:
        assert policy.connect().name == "stand-in"
        assert len(gate.sessions()) == len(inner.sessions()) == 1
        jump = Path(f"/proc/{ssh_of(policy)}/task/{ssh_of(policy)}/children").read_text().split()
        policy.close()
        eventually(lambda: not any(alive(int(pid)) for pid in jump), "the end of the jump's ssh")


# Whole stations, in lockstep.


def assignments(tunnel: dict[str, Any]) -> list[str]:
    return [
        f"policy.tunnel.{name}={value if isinstance(value, int | float) else repr(value)}"
        for name, value in tunnel.items()
    ]


@pytest.mark.exhaustive
def test_a_trial_through_a_tunnel_puts_the_block_on_the_plate(ssh_server: Begin, tmp_path: Path) -> None:
    trial = pick_and_place("tabletop_ur5e", 0, tmp_path / "data", assignments(ssh_server().settings()))
    assert trial.success, (trial.reason, trial.milestones, trial.events)
    assert trial.state is SessionState.RUNNING


@pytest.mark.exhaustive
def test_a_run_holds_naming_the_tunnel_that_broke_and_goes_on_when_it_is_up_again(
    ssh_server: Begin, tmp_path: Path
) -> None:
    server = ssh_server()
    with served("tabletop_ur5e", 0, tmp_path / "data", assignments(server.settings())) as (_, station):
        session = station.coordinator.session
        station.connect()
        station.until(lambda: session.state is not SessionState.DISCONNECTED, 5.0, "first observation")
        station.command("setup")
        station.until(lambda: session.state is not SessionState.SETTING_UP, 60.0, "set-up")
        assert session.state is SessionState.READY, session.reason
        station.command("run")
        station.until(lambda: station.coordinator.inference.metrics.answers > 2, 20.0, "answers")
        server.stop()
        station.until(lambda: session.state is not SessionState.RUNNING, 60.0, "the end of patience")
        assert session.state is SessionState.HOLDING
        assert f"127.0.0.1:{server.port} is down since" in session.reason
        server.start()
        policy = station.coordinator.inference.policy
        assert isinstance(policy, TunnelledPolicy)
        assert policy._keeper is not None
        assert policy._keeper.wait_for(lambda now: now.up, PATIENCE_S).up
        answers = station.coordinator.inference.metrics.answers
        station.command("resume")
        station.until(lambda: station.coordinator.inference.metrics.answers > answers + 2, 20.0, "answers")
        assert session.state is SessionState.RUNNING, session.reason
    assert server.log().count("Accepted publickey") == 2
