"""A press at the panel reaches the coordinator where the guard gives no answer that can be read."""

from __future__ import annotations

from pathlib import Path

import pytest
import zmq

from runtime.clients.panel.stops import Stops
from runtime.core.errors import CodecError, TransportError
from runtime.ipc.messages import Ack


@pytest.mark.parametrize("fault", [TransportError("no answer"), CodecError("no message")])
def test_the_coordinator_is_asked_where_the_guard_does_not_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: Exception
) -> None:
    stops, asked = Stops(zmq.Context.instance(), tmp_path), []

    def answered(command: object, where: tuple[str, str], seconds: float) -> Ack:
        asked.append(where[0])
        if where[0] == "guard":
            raise fault
        return Ack("", "done", "latched")

    monkeypatch.setattr(stops, "_ask", answered)
    told = stops.press("10.0.0.7", "")
    assert (told.done, told.text, asked) == (True, "latched", ["guard", "coordinator"])
