"""A middleware without a network."""

from __future__ import annotations

from collections.abc import Mapping

from runtime.transports.ros.middleware import Deliver, Match, Middleware, Publish, Topic


class FakeMiddleware(Middleware):
    """A middleware whose messages come from the test's own hand."""

    def __init__(self) -> None:
        self.deliver: dict[str, Deliver] = {}
        self.found: dict[str, Match] = {}
        self.closed = False

    def subscribe(self, topic: Topic, deliver: Deliver) -> None:
        self.deliver[topic.name] = deliver

    def advertise(self, topic: Topic) -> Publish:
        raise AssertionError("what only listens publishes nothing")

    def matches(self) -> Mapping[str, Match]:
        return self.found

    def close(self) -> None:
        self.closed = True
