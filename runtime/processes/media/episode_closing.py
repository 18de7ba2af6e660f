"""Closing of an episode: immediately, or on a thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future

from runtime.processes.media.recorder import ClosedEpisode

Close = Callable[[], ClosedEpisode]


def at_once(close: Close) -> Future[ClosedEpisode]:
    """Close an episode immediately, as lockstep does."""
    done: Future[ClosedEpisode] = Future()
    done.set_result(close())
    return done


def in_background(close: Close) -> Future[ClosedEpisode]:
    """Close an episode on a thread of its own, so that a slow disk delays nothing else."""
    done: Future[ClosedEpisode] = Future()

    def run() -> None:
        try:
            done.set_result(close())
        except Exception as error:  # raised by the future's result
            done.set_exception(error)

    threading.Thread(target=run, name="closing", daemon=True).start()
    return done
