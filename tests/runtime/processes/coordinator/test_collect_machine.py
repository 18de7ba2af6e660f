"""Whatever is asked of a station that collects: nothing moves unarmed, no episode is lost, none comes back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import initialize, rule

from runtime.config import loader
from runtime.ipc.session_state import SessionState
from runtime.recording.labels import latest_label
from runtime.station.checks import check_deployment
from tests.runtime.collect_station import CollectStation, CollectStubs
from tests.runtime.lockstep_station import stubbed
from tests.runtime.processes.coordinator.session import test_session_machine
from tests.runtime.processes.coordinator.session.test_session_machine import ticks

ENDED = 60  # ticks in which an episode that has ended is on disk
buttons = st.sampled_from(["arm", "disarm", "run", "stop", "discard", "halt", "resume"])


class Collects(test_session_machine.Machine):
    """The same hands and the same witness, and a person who leads."""

    @initialize(mode=st.sampled_from(["absolute", "relative"]), home=st.booleans())
    def begin(self, mode: str, home: bool) -> None:
        made = stubbed(
            Path(self.folder.name), self.rows, setup={"home": home}, recording={"min_free_bytes": 0}
        ).spec.resolved
        leads = {
            "source": "relay",
            "mode": mode,
            "leader": {"kind": "zmq"},
            "cameras": [camera.key for camera in check_deployment(made).robot.cameras[:1]],
        }
        resolved = loader.apply_changes(made, {"collection": leads}, "test")
        collects = CollectStubs(check_deployment(resolved), rows=self.rows)
        self.opened: dict[str, bool] = {}  # the episodes, and whether each was discarded
        self.watch(CollectStation(collects))

    @rule(pressed=buttons, wait=ticks)
    def press(self, pressed: str, wait: int) -> None:
        station = self.station
        armed, collects = station.collect["armed"], station.coordinator.collecting.set_up
        before = station.collect["episode"] or (list(self.opened)[-1] if self.opened else None)
        self.command((pressed, {}), 0)
        if pressed == "run" and collects and not armed:
            assert station.state is not SessionState.RUNNING
        if pressed == "discard" and before is not None and self.label_of(before):
            self.opened[before] = True
        self.tick(wait)

    @rule(mode=st.just("collect"), wait=ticks)
    def work(self, mode: str, wait: int) -> None:
        """A demonstration, or as much of one as comes about."""
        robot = self.station.robot
        robot.blocked = robot.silent = False
        self.does, self.keeps_lease = "ramp", True
        if "leader" in self.station.stubs.built:
            self.station.leader.silent = False
        if self.station.state is SessionState.FAULTED:
            self.release(3)
        for kind, arguments in (("stop", {}), ("setup", {"collect": True}), ("arm", {}), ("run", {})):
            self.tick(3)
            if kind in self.station.coordinator.session.allowed():
                self.command((kind, arguments), 1)
            for _ in range(200):
                if self.station.state is SessionState.SETTING_UP:
                    self.tick(1)
        self.tick(wait)

    @rule(again=st.booleans(), wait=ticks)
    def ends(self, again: bool, wait: int) -> None:
        """It is kept, or thrown away, and another one begun."""
        self.press("discard" if again else "stop", 3)
        self.press("run", wait)

    @rule(turn=st.floats(-0.02, 0.02), wait=ticks)
    def led(self, turn: float, wait: int) -> None:
        self.station.turn = turn
        self.tick(wait)
        self.station.turn = 0.0

    @rule(silent=st.booleans(), wait=st.integers(1, 40))
    def falls_silent(self, silent: bool, wait: int) -> None:
        if "leader" in self.station.stubs.built:
            self.station.leader.silent = silent
        self.tick(wait)

    def look(self, measured: Any, told: int) -> None:
        super().look(measured, told)
        main = self.station.coordinator
        run = main.run
        if run is not None and run.mode == "collect" and run.uuid:
            self.opened.setdefault(run.uuid, False)
            assert main.session.state is not SessionState.RUNNING or main.collecting.armed, (
                "nobody leads unarmed"
            )

    def asked(self) -> bool:
        main = self.station.coordinator
        leads = main.run is not None and main.run.mode == "collect"
        return super().asked() or (leads and main.session.state is SessionState.RUNNING)

    def label_of(self, episode: str) -> Any:
        label = latest_label(Path(self.folder.name), episode)
        return label is not None and label.discarded

    def teardown(self) -> None:
        if hasattr(self, "station"):
            self.keeps_lease = True
            if "stop" in self.station.coordinator.session.allowed():
                self.command(("stop", {}), 1)
            for episode, discarded in self.opened.items():
                folder = Path(self.folder.name) / "episodes" / episode
                for _ in range(ENDED):
                    if folder.exists() and not (folder / "outcome.json").exists():
                        self.tick(1)
                assert not folder.exists() or (folder / "outcome.json").exists(), (
                    "it ends, and its files stay"
                )
                assert self.label_of(episode) is discarded
        super().teardown()


TestCollects = Collects.TestCase
TestCollects.settings = settings(
    max_examples=8, stateful_step_count=20, suppress_health_check=list(HealthCheck)
)
