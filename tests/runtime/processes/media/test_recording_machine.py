"""Whatever dies, is pressed or is not written: the coordinator takes for recorded what media records."""

from __future__ import annotations

import tempfile
from pathlib import Path

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from runtime.ipc.messages import Ack
from runtime.ipc.session_state import SessionState
from runtime.recording.reader import open_episode
from runtime.station.run import Run
from tests.examples import some
from tests.runtime.lockstep_station import Station, stubbed

SETTLED = 4  # ticks after which an order has gone to media and its answer to the coordinator
ticks = st.integers(0, 6)


class Recorded(RuleBasedStateMachine):
    """A lockstep station whose disk fails and whose siblings are restarted."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.asked: dict[
            str, bool
        ] = {}  # episodes of accepted runs, and whether control was ever told to follow each

    @initialize(on_failure=st.sampled_from(["hold", "continue"]))
    def begin(self, on_failure: str) -> None:
        self.episodes = Path(self.folder.name) / "episodes"
        self.station = Station(stubbed(Path(self.folder.name), recording={"on_failure": on_failure}))
        runs = self.station.coordinator.runs
        follow = runs._follow

        def followed(run: Run, fresh: bool) -> None:
            self.asked[run.uuid] = True
            follow(run, fresh)

        runs._follow = followed  # type: ignore[method-assign]
        self.go(3)

    def go(self, count: int) -> None:
        self.station.go(count)

    @property
    def broken(self) -> bool:
        return self.episodes.is_file()

    def give(self, kind: str, **arguments: object) -> Ack:
        self.station._handle("lease_claim")
        return self.station._handle(kind, arguments)

    @rule(trial=st.booleans(), wait=ticks)
    def run(self, trial: bool, wait: int) -> None:
        if self.station.state is SessionState.IDLE:
            self.station.prepare()
        ack = self.give("run", **({"trial": {"id": 1}} if trial else {}))
        if ack.status == "accepted":
            self.asked.setdefault(ack.data["episode"], False)
        self.go(wait)

    @rule(kind=st.sampled_from(["stop", "halt", "resume", "record_start", "record_stop"]), wait=ticks)
    def press(self, kind: str, wait: int) -> None:
        self.give(kind)
        self.go(wait)

    @rule(process=st.sampled_from(["control", "guard"]), wait=ticks)
    def dies(self, process: str, wait: int) -> None:
        shared = self.station.shared
        shared.set_generation(process, shared.generation(process) + 1)
        self.go(wait)

    @rule(wait=ticks)
    def estop(self, wait: int) -> None:
        self.station.guard.press("anna", "a test")
        self.go(wait)
        self.go(1)
        self.give("release")
        self.go(3)

    @rule()
    def disk(self) -> None:
        """A file where the folder should be: nothing can be opened, what is open goes on."""
        aside = self.episodes.with_name("aside")
        if self.broken:
            self.episodes.unlink()
            if aside.exists():
                aside.rename(self.episodes)
        elif not self.station.media.recording:
            if self.episodes.exists():
                self.episodes.rename(aside)
            self.episodes.write_text("in its place")

    @rule()
    def settles(self) -> None:
        """Nothing is half open, whatever came before."""
        self.go(SETTLED)
        runs = self.station.coordinator.runs
        open_in_main = runs._alone or (runs.open.uuid if runs.open and not runs.open.unrecorded else "")
        recording = self.station.media._recorder.recording
        assert recording == open_in_main or (runs.open is not None and not recording and not runs.open.opened)

    @rule()
    def works_again(self) -> None:
        """With a disk that takes it a run can always be begun and leaves rows."""
        if self.broken:
            self.disk()
        for kind in ("stop", "record_stop"):
            self.give(kind)
            self.go(SETTLED)
        self.run(trial=True, wait=SETTLED)
        assert self.station.state is SessionState.RUNNING
        assert self.station.stop().frames > 0

    @invariant()
    def what_never_began_is_told_and_nothing_else_is(self) -> None:
        if not hasattr(self, "station"):
            return
        told = {}
        for event in self.station.coordinator.events.since(0):
            if unbegun := event["data"].get("unbegun"):
                told[unbegun["episode"]] = unbegun["unopened"]
        run = self.station.coordinator.run
        for episode, ran in self.asked.items():
            assert (episode in told) == (not ran and (run is None or run.uuid != episode))
        for episode, unopened in told.items():
            folder = next((root / episode for root in self.roots() if (root / episode).exists()), None)
            assert folder is None or not unopened
            if folder is not None and (folder / "outcome.json").exists():
                assert open_episode(folder).frames == 0

    def roots(self) -> list[Path]:
        return [root for root in (self.episodes, self.episodes.with_name("aside")) if root.is_dir()]

    def teardown(self) -> None:
        if hasattr(self, "station"):
            self.station.close()
        self.folder.cleanup()


def test_a_run_that_was_halted_before_it_began_leaves_no_row() -> None:
    """Found at random: it was told as one that never began, and its recording had the rows of standing still."""
    state = Recorded()
    try:
        state.begin("hold")
        state.run(trial=False, wait=0)
        state.press("halt", 2)
        state.what_never_began_is_told_and_nothing_else_is()
        state.works_again()
        state.what_never_began_is_told_and_nothing_else_is()
    finally:
        state.teardown()


TestRecorded = Recorded.TestCase
TestRecorded.settings = settings(
    max_examples=some(20),
    stateful_step_count=20,
    suppress_health_check=[HealthCheck.too_slow],
)
