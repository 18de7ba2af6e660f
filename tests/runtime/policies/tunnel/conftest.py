from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from runtime.policies.tunnel.ssh_process import free_port
from tests.ssh import SshServer


@pytest.fixture
def ssh_server(tmp_path: Path) -> Iterator[Callable[..., SshServer]]:
    """Starts SSH servers, each in a folder of its own, and ends them with the test."""
    running: list[SshServer] = []

    def begin(**options: str) -> SshServer:
        running.append(SshServer(tmp_path / f"ssh{len(running)}", free_port(), **options))
        return running[-1].start()

    yield begin
    for server in running:
        server.stop()
