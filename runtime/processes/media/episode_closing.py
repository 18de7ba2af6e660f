"""Closing of an episode: here and now, or beside the work."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future

from runtime.processes.media.recorder import ClosedEpisode

Close = Callable[[], ClosedEpisode]


def at_once(close: Close) -> Future[ClosedEpisode]:
    """Close an episode here and now, as lockstep does."""
    done: Future[ClosedEpisode] = Future()
    done.set_result(close())
    return done


def in_background(close: Close) -> Future[ClosedEpisode]:
    """Close an episode on a thread of its own, so that a slow disk stops nothing else."""
    done: Future[ClosedEpisode] = Future()

    def run() -> None:
        try:
            done.set_result(close())
        except Exception as error:  # raised where the result is asked for
            done.set_exception(error)

    threading.Thread(target=run, name="closing", daemon=True).start()
    return done
