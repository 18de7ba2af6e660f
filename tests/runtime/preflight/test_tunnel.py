"""A preflight through an SSH tunnel opens it as a station does, and leaves none behind."""

from __future__ import annotations

import contextlib
import shutil
import threading
from pathlib import Path

import pytest

from runtime.config.loader import server_address
from runtime.policies.tunnel.ssh_process import free_port
from runtime.preflight.runner import PreflightRunner
from runtime.station.preflight_child import default_deadline
from tests.processes import joined
from tests.runtime.preflight.bench import WIRES, planned, served
from tests.ssh import SshServer

needs_ssh = pytest.mark.skipif(shutil.which("ssh") is None, reason="ssh is not installed")


@needs_ssh
def test_a_tunnel_that_does_not_stand_is_a_verdict_of_its_own() -> None:
    tunnel = {"host": "127.0.0.1", "port": free_port()}
    report = PreflightRunner(planned(WIRES["openpi"], "ws://127.0.0.1:8000", {"tunnel": tunnel})).run(60.0)
    assert (report.verdict, report.stage) == ("tunnel", "connect"), report.sentence
    assert "there is no tunnel to 127.0.0.1" in report.sentence


@pytest.mark.slow
def test_a_server_behind_a_tunnel_is_asked_and_the_tunnel_is_gone_afterwards(tmp_path: Path) -> None:
    before = set(threading.enumerate())
    with contextlib.closing(contextlib.ExitStack()) as stack, served("openpi") as url:
        server = SshServer(tmp_path / "ssh", free_port()).start()
        stack.callback(server.stop)
        spec = planned(WIRES["openpi"], url, {"tunnel": server.settings()})
        report = PreflightRunner(spec).run(60.0)
        assert report.ok, report.sentence
        closed = PreflightRunner(
            planned(WIRES["openpi"], "ws://127.0.0.1:1", {"tunnel": server.settings()})
        ).run(60.0)
        assert (closed.verdict, closed.stage) == ("port_closed", "connect"), closed.sentence
    for thread in set(threading.enumerate()) - before:
        joined(thread)


def test_the_same_address_behind_another_tunnel_is_another_server() -> None:
    here = planned(WIRES["openpi"], "ws://127.0.0.1:8000").deployment
    there = planned(WIRES["openpi"], "ws://127.0.0.1:8000", {"tunnel": {"host": "gpu-1.lab"}}).deployment
    elsewhere = planned(WIRES["openpi"], "ws://localhost:8000", {"tunnel": {"host": "gpu-2.lab"}}).deployment
    assert len({server_address(one) for one in (here, there, elsewhere)}) == 3
    assert default_deadline(there) > default_deadline(here)
