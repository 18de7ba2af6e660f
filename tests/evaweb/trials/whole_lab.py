"""Trials of a whole station in lockstep, run as console and chronicle run them."""

from dataclasses import replace
from pathlib import Path

import pytest

from evaweb.episodes.folders import journal_folder
from evaweb.episodes.services import record_closed
from evaweb.jobs import doorbell
from evaweb.trials import services
from evaweb.trials.station_commands import trial_command
from runtime.recording.export import write_export
from tests.evaweb.trials import builders
from tests.runtime.lockstep_station import Station as Lockstep
from tests.runtime.lockstep_station import stubbed


class Direct:
    """The wire to a station in this process, under a lease of its own."""

    def __init__(self, station):
        self._station = station

    def request_urgent(self, command, process, key, timeout):
        return self.request(command)

    def status(self):
        return self._station.coordinator.snapshot()

    def request(self, command, **how):
        self._station._handle("lease_claim")
        main = self._station.coordinator
        held = {"holder": "lockstep", "epoch": main.lease.epoch, "boot": main.boot}
        return main.handle(replace(command, **held, sequence=main.session.sequence))


@pytest.fixture
def lab(tmp_path, monkeypatch, db):
    """A lab around a whole station in lockstep."""
    monkeypatch.setattr(doorbell, "notify_workers", lambda queue: True)
    made = Lab(builders.bench("bench"), Lockstep(stubbed(tmp_path, simulated=True)))
    for place in ("evaweb.stations.commands", "evaweb.stations.stops", "evaweb.trials.station_commands"):
        monkeypatch.setattr(f"{place}.connection_to", lambda name: Direct(made.station))
    yield made
    made.station.close()  # its writer would go on into the tests that follow


class Lab:
    """Runs trials as console and chronicle do."""

    def __init__(self, bench, station):
        self.bench, self.station = bench, station
        bench.checkpoint.policy = {}  # the deployment's own
        bench.checkpoint.save()
        self._heard = 0

    def give(self, trial, kind):
        order = {
            "user": self.bench.operator,
            "page": "p",
            "epoch": 1,
            "boot": self.station.coordinator.boot,
            "sequence": 0,
        }
        row = trial_command(trial=trial, kind=kind, **order)
        assert row.status in ("accepted", "done"), row.reason

    def run(self, ticks=12, smoke=False, **given):
        """A trial that has ended, or was interrupted by an e-stop."""
        trial = self.bench.prepare(**given)
        self.station.until(
            lambda: str(self.station.state) in ("idle", "ready"), 30.0, "a state to set up from"
        )
        self.give(trial, "setup")
        self.station.until(lambda: str(self.station.state) == "ready", 60.0, "set-up")
        self.give(trial, "run")
        self.station.go(ticks)
        if smoke:
            self.station.guard.press("ann", "smoke")
        else:
            self.give(trial, "stop")
        self.station.go(3)
        self.listen()
        trial.refresh_from_db()
        return trial

    def folder(self, trial):
        return journal_folder(trial.episode_id)

    def listen(self):
        """Hand the station's events on, as the chronicle does."""
        for event in self.station.coordinator.events.since(self._heard):
            self._heard = event["number"]
            if event["kind"] == "episode_closed":
                write_export(Path(event["data"]["path"]), self.station.spec.deployment.data)  # as media does
                record_closed(station=self.bench.station, data=event["data"])
            services.apply_station_event(
                station=self.bench.station, event=event, boot=self.station.coordinator.boot
            )

    def score(self, trial, *reached, **words):
        ticks = self.bench.ticks(*reached)
        return services.score_trial(user=self.bench.operator, trial=trial, milestones=ticks, **words)
