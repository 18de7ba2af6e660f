"""A real SSH server on loopback with keys of its own, run by whoever runs the tests; skips where there is none."""

from __future__ import annotations

import contextlib
import getpass
import os
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from tests.processes import PATIENCE_S, eventually

SSHD = shutil.which("sshd") or shutil.which("/usr/sbin/sshd")
_PRIVILEGE_SEPARATION = Path("/run/sshd")  # a server of root wants it; the service of a system makes it


def required() -> None:
    """Skip where the programs are missing."""
    for name, path in (
        ("sshd", SSHD),
        ("ssh", shutil.which("ssh")),
        ("ssh-keygen", shutil.which("ssh-keygen")),
    ):
        if path is None:
            pytest.skip(f"{name} is not installed (on Debian: apt-get install openssh-server openssh-client)")


def key(path: Path) -> Path:
    """A new key without a passphrase, and `path`.pub beside it."""
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "test", "-f", path], check=True)
    return path


class SshServer:
    """One server that knows one key; it may be ended and started again, at the same port and with the same keys."""

    def __init__(self, folder: Path, port: int, **options: str) -> None:
        required()
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.port = folder, port
        self.host_key, self.identity = key(folder / "host"), key(folder / "identity")
        self.known_hosts = folder / "known_hosts"
        kind, public = (folder / "host.pub").read_text().split()[:2]
        self.known_hosts.write_text(f"[127.0.0.1]:{port} {kind} {public}\n")
        settings = {
            "Port": str(port),
            "ListenAddress": "127.0.0.1",
            "HostKey": str(self.host_key),
            "AuthorizedKeysFile": str(folder / "identity.pub"),
            "PidFile": "none",
            "StrictModes": "no",
            "UsePAM": "no",
            "PasswordAuthentication": "no",
            "KbdInteractiveAuthentication": "no",
            **options,
        }
        self._configuration = folder / "sshd_config"
        self._configuration.write_text("".join(f"{name} {value}\n" for name, value in settings.items()))
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> SshServer:
        """Listen, and be back when it does."""
        assert SSHD is not None
        if os.getuid() == 0:
            _PRIVILEGE_SEPARATION.mkdir(mode=0o755, exist_ok=True)
        with (self.folder / "log").open("ab") as log:
            begun = log.tell()
            self._process = subprocess.Popen([SSHD, "-D", "-e", "-f", self._configuration], stderr=log)
        eventually(lambda: "Server listening" in self.log(begun), f"an SSH server: {self.log()}")
        return self

    def log(self, begun: int = 0) -> str:
        return (self.folder / "log").read_bytes()[begun:].decode()

    def sessions(self) -> list[int]:
        """The processes of its connections."""
        assert self._process is not None
        found = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text()
        return [int(pid) for pid in found.split()]

    def stop(self) -> None:
        """End it and all its connections; safe to call twice."""
        process, self._process = self._process, None
        if process is None:
            return
        children = f"/proc/{process.pid}/task/{process.pid}/children"
        sessions = [int(pid) for pid in Path(children).read_text().split()]
        process.terminate()
        process.wait(PATIENCE_S)
        for pid in sessions:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)

    def settings(self, **changes: object) -> dict[str, object]:
        """A tunnel that leads here."""
        return {
            "host": "127.0.0.1",
            "port": self.port,
            "user": getpass.getuser(),
            "identity_file": str(self.identity),
            "known_hosts_file": str(self.known_hosts),
            "ssh_config": "none",
            "connect_deadline": 60.0,  # machines of tests are busy
            **changes,
        }
