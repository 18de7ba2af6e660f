"""Context of the two fragments of a station's Collect page."""

from __future__ import annotations

from typing import Any

from evaweb.collect import selectors
from evaweb.collect.work import session_queue
from evaweb.stations.models import Station

SHOWN = 8  # listed jobs; the remaining ones are counted


def session_panel(*, station: Station) -> dict[str, Any]:
    """Return the open session with its counts, else the data for opening or resuming one."""
    session = selectors.session_open(station=station)
    context: dict[str, Any] = {"station": station, "session": session}
    if session is not None:
        return {**context, "counts": selectors.session_counts(session=session)}
    earlier = list(selectors.resumable_sessions(station=station))
    return {
        **context,
        "earlier": earlier,
        "tasks": selectors.earlier_tasks(station=station),
        "dataset": earlier[0].dataset if earlier else "",
    }


def progress_panel(*, station: Station) -> dict[str, Any]:
    """Return for the open session its last episode, the job queue, and what can be published."""
    session = selectors.session_open(station=station)
    context: dict[str, Any] = {"station": station, "session": session}
    if session is None:
        return context
    queue = session_queue(session=session)
    return {
        **context,
        "counts": selectors.session_counts(session=session),
        "last": selectors.demonstrations_of(session=session).first(),
        "queue": queue,
        "listed": queue.items[:SHOWN],
        "more": max(0, len(queue.items) - SHOWN),
        "dataset": selectors.dataset_of(session=session),
        "accepted": selectors.unpublished_demonstrations(session=session).count(),
        "failures": selectors.unpublished_demonstrations(session=session, results=("fail",)).count(),
    }
