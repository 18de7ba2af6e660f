"""Starting of deployments that are written to the data folder while the lab runs.

The lab's watch loop is not blocked meanwhile.
"""

from __future__ import annotations

import logging
from collections.abc import Generator

from django.db import Error, close_old_connections

from evaweb.core.errors import EvaError
from evaweb.lab import deployments, simulated
from evaweb.lab.benches import Bench, program_of, registered
from evaweb.lab.deployments import Standing, StoredDeployment, is_simulated
from evaweb.lab.processes import ChildProcesses, LabError

log = logging.getLogger(__name__)
Coming = Generator[str, None, bool]  # yields what is being started; returns whether anything was started


class Pickup:
    """Starter of the data folder's simulated stations, one after the other; call `poll` regularly."""

    def __init__(self, processes: ChildProcesses, how: simulated.Benches) -> None:
        self._processes, self._how = processes, how
        self._tried: dict[str, int] = {}  # by name: modification time of the file that was last tried
        self._up: set[str] = set()
        self._brought: set[str] = (
            set()
        )  # stations whose programs were started here: only these are ended here
        self._fault = ""  # last error, to log it once
        self._coming: tuple[str, Coming] | None = None
        self._told: dict[str, Standing] = {}

    def poll(self) -> None:
        """Continue the start of a station, or begin that of the next one whose file is new or was touched.

        Errors never end the lab or its other stations.
        """
        try:
            self._look()
        except Exception as fault:  # an error of the folder itself: logged once, retried at the next call
            if self._fault != repr(fault):
                log.exception("the folder of deployments cannot be looked at")
            self._fault = repr(fault)
        else:
            self._fault = ""

    def _look(self) -> None:
        if self._coming is None:
            self._end_removed()
            self._coming = self._next()
        if self._coming is None:
            return
        name, coming = self._coming
        try:
            self._write_status(name, Standing(doing=next(coming)))
        except StopIteration as done:
            self._coming = None
            self._up.add(name)
            if done.value:
                self._write_status(name, Standing(up=True))
        except (EvaError, Error, OSError) as fault:
            self._give_up(name, str(fault))
        except Exception as fault:  # the file, and the rows to which it refers, may contain anything
            log.exception("%s cannot be started", name)
            self._give_up(name, f"{type(fault).__name__}: {fault} (see the terminal of the lab)")

    def _give_up(self, name: str, reason: str) -> None:
        self._coming = None
        self._end(name)
        self._write_status(name, Standing(failed=reason))

    def _end(self, name: str) -> None:
        """End the programs that were started for a station."""
        if name in self._brought:
            self._brought.discard(name)
            for program in _programs_of(name):
                self._processes.drop(program)
            log.info("what was started for %s is ended", name)

    def _end_removed(self) -> None:
        for name in [name for name in self._up if deployments.stored_deployment(name) is None]:
            self._up.discard(name)
            self._tried.pop(name, None)
            self._told.pop(name, None)
            log.info("%s is removed from the folder of deployments", name)
            self._end(name)

    def _next(self) -> tuple[str, Coming] | None:
        ending = self._processes.ending()
        for stored in deployments.stored_deployments():
            if ending.intersection(_programs_of(stored.name)):
                continue  # programs of an earlier file with this name
            if stored.name not in self._up and self._tried.get(stored.name) != stored.changed_ns:
                self._tried[stored.name] = stored.changed_ns
                return stored.name, self._starting(stored)
        return None

    def _starting(self, stored: StoredDeployment) -> Coming:
        resolved = stored.resolved()
        if not (stored.chosen and is_simulated(resolved)):
            return False  # a draft, or written by hand: a person starts it
        if resolved.deployment.station != stored.name:
            raise LabError(
                f"{stored.path} is of station {resolved.deployment.station!r}: name the file after it"
            )
        running = self._processes.pids()
        for program in _programs_of(stored.name):
            if program in running:
                raise LabError(
                    f"{program} is a program of this lab already: remove this station, and give it another name"
                )
        self._brought.add(stored.name)
        close_old_connections()
        yield "the simulated bench"
        assignments = yield from simulated.bring(
            self._processes, stored.name, resolved.deployment.robot, stored.path, self._how
        )
        yield "the station"
        bench = Bench(stored.path, assignments)
        registered(bench)  # raises LabError if the file was removed meanwhile
        self._processes.start(program_of(bench))
        return True

    def _write_status(self, name: str, standing: Standing) -> None:
        if self._told.get(name) == standing:
            return
        self._told[name] = standing
        if standing.failed:
            log.error("%s is not started: %s", name, standing.failed)
        elif standing.up:
            log.info("%s is started from the folder of deployments", name)
        if deployments.stored_deployment(name) is None:
            return
        try:
            deployments.write_status(name, standing)
        except OSError as error:  # the page shows an old status; the lab continues
            log.error("what becomes of %s cannot be written down: %s", name, error)


def _programs_of(name: str) -> tuple[str, str]:
    """Return the names of the programs that belong to one simulated station."""
    return f"station-{name}", f"bench-{name}"
