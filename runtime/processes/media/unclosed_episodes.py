"""Episodes whose end did not fit on the disk: closing them is retried until there is room."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, wait

from runtime.core.backoff import BackOff
from runtime.processes.media.recorder import ClosedEpisode

Close = Callable[[], ClosedEpisode]


def at_once(close: Close) -> Future[ClosedEpisode]:
    """Close an episode immediately in this thread, as a lockstep station does; the result is known at once."""
    future: Future[ClosedEpisode] = Future()
    future.set_result(close())
    return future


def in_background(close: Close) -> Future[ClosedEpisode]:
    """Close an episode on a thread of its own, so that a slow disk delays nothing else."""
    future: Future[ClosedEpisode] = Future()

    def run() -> None:
        try:
            future.set_result(close())
        except Exception as error:  # raised by the future's result
            future.set_exception(error)

    threading.Thread(target=run, name="closing", daemon=True).start()
    return future


_FIRST_S, _MOST_S = 1.0, 30.0  # pauses between attempts [s], doubled each time


class UnclosedEpisodes:
    """Queue of episodes whose closing is retried, oldest first.

    After a success the next episode is tried at once. Call `poll` regularly.
    """

    def __init__(self, closer: Callable[[Close], Future[ClosedEpisode]], now: Callable[[], float]) -> None:
        self._closer = closer
        self._now = now
        self._episodes: deque[ClosedEpisode] = deque()
        self._attempt: Future[ClosedEpisode] | None = None
        self._back_off = BackOff(_FIRST_S, _MOST_S)

    @property
    def errors(self) -> dict[str, str]:
        """Error of each waiting episode, by uuid."""
        return {episode.uuid: episode.error for episode in self._episodes}

    def add(self, episode: ClosedEpisode) -> None:
        """Add an episode that has a `retry`."""
        if not self._episodes:
            self._back_off.record_failure(self._now())
        self._episodes.append(episode)

    def poll(self) -> ClosedEpisode | None:
        """Return an episode that is closed now, or None; start an attempt if one is due. Never waits for the disk."""
        if self._attempt is None and self._episodes and not self._back_off.remaining_delay(self._now()):
            retry = self._episodes[0].retry
            assert retry is not None
            self._attempt = self._closer(retry)
        if self._attempt is None or not self._attempt.done():
            return None
        closed, self._attempt = self._attempt.result(), None
        if closed.retry is None:
            self._episodes.popleft()
            self._back_off.reset()
            return closed
        self._episodes[0] = closed
        self._back_off.record_failure(self._now())
        return None

    def finish(self, seconds: float) -> ClosedEpisode | None:
        """Try once more to close an episode, waiting at most `seconds` [s].

        Return the episode that is closed now, or None. Repair completes the remaining episodes later.
        """
        self._back_off.reset()
        closed = self.poll()
        if closed is None and self._attempt is not None:
            wait([self._attempt], seconds)
            closed = self.poll()
        return closed
