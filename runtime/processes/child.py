"""Start of a station process: its specification, the shared state, a lifeline, a log."""

from __future__ import annotations

import argparse
from collections.abc import Collection
from dataclasses import dataclass

from runtime.core import logs as log
from runtime.ipc.bells import bells
from runtime.ipc.lifeline import Lifeline
from runtime.ipc.membership import Membership
from runtime.ipc.shared_state import SharedState
from runtime.station.spec import StationSpec, load_checked_spec


@dataclass(frozen=True, slots=True)
class ProcessContext(Membership):
    """Membership of a process in its station, with the station's specification."""

    spec: StationSpec


def join_station(process: str, pictures: bool = True, unread: Collection[str] = ()) -> ProcessContext:
    """Parse the supervisor's command line, start the log, and attach the shared state.

    The shared pictures are attached only if `pictures` is True. `unread` names sections of the deployment that are not
    loaded, see `load_checked_spec`.
    """
    parser = argparse.ArgumentParser(prog=f"runtime.{process}", description="started by the supervisor")
    parser.add_argument("--resolved", required=True)
    parser.add_argument("--capabilities", required=True)
    parser.add_argument("--shared", required=True, type=int)
    parser.add_argument("--bells", required=True, type=bells)
    parser.add_argument("--boot", required=True)
    arguments = parser.parse_args()
    log.configure_logging(process)
    spec = load_checked_spec(arguments.resolved, arguments.capabilities, unread)
    shared = SharedState.attach(spec.layout, arguments.shared, pictures)
    shared.hang(arguments.bells)
    return ProcessContext(shared, arguments.boot, Lifeline(), spec)
