from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from tests.processes import PATIENCE_S


@dataclass
class StandIn:
    """A stand-in's process and what it announced."""

    process: subprocess.Popen[bytes]
    ready: dict[str, Any]


Start = Callable[..., StandIn]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts `python -m MODULE ARGUMENTS --lifeline` and waits for its first line; ends it with the test."""
    running: list[subprocess.Popen[bytes]] = []

    def begin(module: str, *arguments: str) -> StandIn:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments, "--lifeline"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        running.append(process)
        assert process.stdout is not None
        return StandIn(process, json.loads(process.stdout.readline()))

    yield begin
    for process in running:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.close()
        process.wait(PATIENCE_S)
        process.stdout.close()
