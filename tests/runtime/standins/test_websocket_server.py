from __future__ import annotations

from websockets.sync.client import connect

from runtime.standins.faults import Fault
from runtime.standins.websocket_server import Answering, Frames, WebsocketServer
from tests.processes import PATIENCE_S, eventually


class Echo(WebsocketServer):
    """Answers with the request, and keeps account of its answers."""

    def __init__(self, fault: Fault) -> None:
        super().__init__("echo", fault)
        self.durations: list[float] = []

    def greeting(self) -> Frames:
        return "hello"

    def begin(self) -> Answering:
        return lambda request: request

    def on_answered(self, answer: Answering, seconds: float) -> None:
        self.durations.append(seconds)


def test_only_an_answer_that_was_sent_counts_as_answered() -> None:
    server = Echo(Fault("mute_on_infer", "1"))
    url = str(server.start()["url"])
    try:
        with connect(url) as client:
            assert client.recv(PATIENCE_S) == "hello"
            client.send("first")
            assert client.recv(PATIENCE_S) == "first"
            client.send("second")
            client.send("third")
            eventually(lambda: server._asked == 3, "the third request, after all that the second leads to")
            assert len(server.durations) == 1
            assert server.durations[0] >= 0.0
    finally:
        server.close()
