"""Signs of life go on through a locked database and stop with the work."""

from __future__ import annotations

import threading

from django.db import OperationalError

from evaweb.jobs.heartbeat import Heartbeat, Lapse
from tests.processes import PATIENCE_S, joined


def test_it_beats_until_the_block_is_left_also_after_an_error() -> None:
    beats: list[int] = []
    enough = threading.Event()

    def beat() -> bool:
        beats.append(len(beats))
        if len(beats) == 2:
            raise OperationalError("database is locked")
        if len(beats) == 4:
            enough.set()
        return True

    with Heartbeat(beat, 0.001):
        assert enough.wait(PATIENCE_S)
    counted = len(beats)
    assert counted >= 4
    assert not [thread for thread in threading.enumerate() if thread.name == "heartbeat"]


def test_it_stops_where_the_job_is_not_ours_any_more() -> None:
    beats: list[int] = []
    with Heartbeat(lambda: bool(beats.append(1)), 0.001) as heart:
        joined(heart._thread)
        assert beats == [1]


def test_it_lapses_where_no_beat_arrives_and_only_then() -> None:
    lapsed = threading.Event()

    def beat() -> bool:
        raise OperationalError("the server closed the connection")

    with Heartbeat(beat, 0.01, Lapse(0.05, lapsed.set)):
        assert lapsed.wait(PATIENCE_S)
    again = threading.Event()
    with Heartbeat(lambda: True, 0.001, Lapse(3600.0, again.set)):
        pass
    assert not again.is_set()
    for timer in [one for one in threading.enumerate() if isinstance(one, threading.Timer)]:
        joined(timer)


def test_it_lapses_at_once_where_the_job_is_anothers() -> None:
    lapsed = threading.Event()
    with Heartbeat(lambda: False, 0.001, Lapse(3600.0, lapsed.set)):
        assert lapsed.wait(PATIENCE_S)
