"""Kinds of jobs under the test's hand."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from evaweb.jobs import doorbell, kinds
from evaweb.jobs.kinds import Args, JobContext


class Toy:
    """A kind of job: says what it was asked, then does what the test tells it."""

    def __init__(self) -> None:
        self.asked: list[Args] = []
        self.does: Callable[[JobContext], Args] = lambda work: {"seen": dict(work.args)}

    def __call__(self, work: JobContext) -> Args:
        self.asked.append(work.args)
        return self.does(work)


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Toy:
    made = Toy()
    monkeypatch.setitem(kinds._kinds, "toy", kinds.Declared(made))
    return made


@pytest.fixture
def rung(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The queues whose doorbell was rung; no broker hears of it."""
    queues: list[str] = []
    monkeypatch.setattr(doorbell, "notify_workers", queues.append)
    return queues
