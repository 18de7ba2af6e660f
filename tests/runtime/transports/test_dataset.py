from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.core.clock import VirtualClock
from runtime.core.errors import RecordingError, SetupError, TransportError
from runtime.core.types import Observation, RobotCommand
from runtime.datasets.mapping import ColumnMapping
from runtime.transports import dataset
from runtime.transports.dataset import Config, DatasetSource
from tests.runtime.datasets.small import robot, seen, write_dataset

FRAMES, FPS = 12, 10.0
MAPPING = ColumnMapping(eef="observation.eef", action_eef="action_eef")


class Stage:
    """A connected source, its clock, and the rows that it must play."""

    def __init__(self, root: Path, **options: Any) -> None:
        self.rows = write_dataset(root, lengths=(FRAMES,), fps=FPS)[0]
        self.clock = VirtualClock(100.0)
        config = Config(path=str(root), mapping=MAPPING, **options)
        self.source: DatasetSource = dataset.source(config, robot(), self.clock)
        self.source.connect()

    def at(self, time: float) -> Observation | None:
        self.clock.sleep_until(time)
        return self.source.receive(0.0)

    def shows(self, observation: Observation | None, row: int) -> bool:
        """Whether `observation` is row `row` in everything, pictures too."""
        assert observation is not None
        numbers = {seen(pixels) for pixels in observation.pictures.values()}
        return (
            numbers == {row}
            and observation.pictures.keys() == {"cam_high", "cam_wrist"}
            and np.array_equal(observation.qpos, self.rows["observation.state"][row])
            and np.array_equal(observation.eef, self.rows["observation.eef"][row])
            and np.array_equal(observation.reported_action, self.rows["action"][row])
            and np.array_equal(observation.reported_action_eef, self.rows["action_eef"][row])
        )


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    stage = Stage(tmp_path)
    yield stage
    stage.source.close()


def test_in_lockstep_every_due_time_brings_its_frame(stage: Stage) -> None:
    stage.source.begin_run()
    for k in range(FRAMES):
        observation = stage.at(100.0 + k / FPS)
        assert stage.shows(observation, k)
        assert observation is not None
        assert observation.last is (k == FRAMES - 1)
        assert stage.source.receive(0.0) is None
    assert stage.source.faults() == {"skipped_frames": 0}


def test_a_wait_ends_at_the_next_due_time(stage: Stage) -> None:
    stage.source.begin_run()
    for k in range(FRAMES):
        assert stage.shows(stage.source.receive(5.0), k)
        assert stage.clock.now() == pytest.approx(100.0 + k / FPS, abs=1e-6)


def test_a_wait_never_moves_the_clock_beyond_what_was_asked(stage: Stage) -> None:
    stage.source.begin_run()
    stage.source.receive(0.0)
    assert stage.source.receive(0.03) is None
    assert stage.clock.now() == pytest.approx(100.03)
    assert stage.source.receive(0.0) is None
    assert stage.clock.now() == pytest.approx(100.03)


def test_a_time_a_hair_before_the_due_time_counts(stage: Stage) -> None:
    stage.source.begin_run()
    stage.at(100.0)
    observation = stage.at(100.1 - 5e-7)
    assert stage.shows(observation, 1)
    assert observation is not None
    assert observation.captured["joints"] <= observation.arrived


def test_a_late_reader_gets_the_newest_frame_and_the_others_are_counted(stage: Stage) -> None:
    stage.source.begin_run()
    stage.at(100.0)
    assert stage.shows(stage.at(100.57), 5)
    assert stage.source.faults() == {"skipped_frames": 4}
    assert stage.shows(stage.at(100.6), 6)


def test_captured_is_the_due_time_of_every_stream(stage: Stage) -> None:
    stage.source.begin_run()
    observation = stage.at(100.25)
    assert observation is not None
    assert observation.captured == dict.fromkeys(("joints", "eef", "cam_high", "cam_wrist"), 100.2)
    assert observation.arrived == 100.25


def test_after_the_last_frame_nothing_comes_and_the_wait_is_kept(stage: Stage) -> None:
    stage.source.begin_run()
    last = stage.at(103.0)
    assert last is not None
    assert last.last
    assert stage.source.receive(0.5) is None
    assert stage.clock.now() == pytest.approx(103.5)
    assert stage.at(110.0) is None


def test_before_a_run_the_first_frame_comes_again_and_again_at_the_recorded_rate(stage: Stage) -> None:
    first = stage.source.receive(0.0)
    assert stage.shows(first, 0)
    assert stage.source.receive(0.0) is None
    second = stage.source.receive(1.0)
    assert stage.shows(second, 0)
    assert first is not None
    assert second is not None
    assert stage.clock.now() == pytest.approx(100.1)
    assert second.sequence == first.sequence + 1
    assert second.captured["joints"] == pytest.approx(100.1)
    assert not second.last


def test_a_run_can_begin_again_from_anywhere(stage: Stage) -> None:
    stage.source.begin_run()
    stage.at(100.9)
    stage.clock.sleep_until(200.0)
    stage.source.begin_run()
    assert stage.shows(stage.at(200.0), 0)
    assert stage.shows(stage.at(200.1), 1)


def test_between_two_runs_the_robot_stands_where_they_begin(stage: Stage) -> None:
    stage.source.begin_run()
    assert stage.shows(stage.at(100.9), 9)
    stage.source.end_run()
    standing = stage.source.receive(0.0)
    assert stage.shows(standing, 0)
    assert standing is not None
    assert not standing.last
    assert standing.captured["joints"] == pytest.approx(100.9)
    assert stage.source.receive(0.05) is None
    stage.source.begin_run()
    assert stage.shows(stage.source.receive(0.0), 0)
    assert stage.shows(stage.source.receive(1.0), 1)


def test_after_the_last_frame_a_second_run_plays_it_all_again(stage: Stage) -> None:
    for begin in (100.0, 200.0):
        stage.clock.sleep_until(begin)
        stage.source.begin_run()
        received = [stage.at(begin + k / FPS) for k in range(FRAMES)]
        assert [stage.shows(observation, k) for k, observation in enumerate(received)] == [True] * FRAMES
        stage.source.end_run()


def test_a_frame_that_breaks_is_named_and_the_next_one_comes(stage: Stage) -> None:
    stage.source.begin_run()
    assert stage.shows(stage.at(100.0), 0)
    whole = stage.source._pictures["cam_wrist"]

    class Broken(type(whole)):  # type: ignore[misc]
        def __init__(self) -> None:
            pass

        def __getitem__(self, index: int) -> Any:
            if index == 1:
                raise RecordingError("wrist.mp4, frame 1 cannot be decoded")
            return whole[index]

    stage.source._pictures["cam_wrist"] = Broken()
    with pytest.raises(TransportError, match=r"wrist\.mp4, frame 1 cannot be decoded"):
        stage.source.receive(1.0)
    assert stage.clock.now() == pytest.approx(100.1)  # told when it is due, though decoded ahead
    assert stage.source.receive(0.0) is None
    assert stage.shows(stage.source.receive(1.0), 2)
    stage.source._pictures["cam_wrist"] = whole


def test_sequence_numbers_rise_over_setup_and_runs(stage: Stage) -> None:
    received = [stage.source.receive(0.0), stage.source.receive(1.0)]
    stage.source.begin_run()
    received += [stage.source.receive(1.0), stage.source.receive(1.0)]
    stage.source.begin_run()
    received += [stage.source.receive(1.0)]
    assert [observation.sequence for observation in received if observation] == [1, 2, 3, 4, 5]


def test_a_run_can_start_with_a_later_frame(tmp_path: Path) -> None:
    stage = Stage(tmp_path, start_frame=9)
    assert stage.shows(stage.source.receive(0.0), 9)
    stage.source.begin_run()
    rows = [stage.source.receive(1.0) for _ in range(3)]
    assert [stage.shows(row, 9 + k) for k, row in enumerate(rows)] == [True] * 3
    assert [row.last for row in rows if row] == [False, False, True]
    assert stage.source.receive(1.0) is None


def test_the_recorded_task_is_the_prompt(stage: Stage) -> None:
    observation = stage.source.receive(0.0)
    assert observation is not None
    assert observation.prompt == "task 0"


def test_it_moves_nothing_ends_and_measures_what_is_mapped() -> None:
    plain = dataset.capabilities(Config(path="x"))
    assert (plain.moves_robot, plain.is_finite, plain.measures_eef) == (False, True, False)
    assert dataset.capabilities(Config(path="x", mapping=MAPPING)).measures_eef


def test_the_sink_counts_commands() -> None:
    sink = dataset.sink(Config(path="x"), robot(), VirtualClock())
    sink.connect()
    for step in range(3):
        sink.send(RobotCommand(np.zeros(6, np.float32), step, 0.0))
    sink.close()
    assert sink.commands == 3


def test_without_connect_it_says_so(tmp_path: Path) -> None:
    source = dataset.source(Config(path=str(tmp_path)), robot(), VirtualClock())
    with pytest.raises(TransportError, match="not connected"):
        source.receive(0.0)


@pytest.mark.parametrize(
    ("bench", "options", "error", "named"),
    [
        (robot(dim=14), {}, SetupError, "state column is 6 wide, small needs 14"),
        (robot(cameras=("cam_low",)), {}, TransportError, "cam_low.*observation.images.cam_high"),
        (robot(), {"episode": 4}, TransportError, "no episode 4"),
        (robot(), {"start_frame": 12}, SetupError, "frames 0 to 11"),
        (robot(), {"mapping": ColumnMapping(effort="torque")}, TransportError, "'torque'.*observation.state"),
    ],
)
def test_what_does_not_fit_is_refused_at_connect(
    tmp_path: Path, bench: Any, options: dict[str, Any], error: type[Exception], named: str
) -> None:
    write_dataset(tmp_path)
    source = dataset.source(Config(path=str(tmp_path), **options), bench, VirtualClock())
    with pytest.raises(error, match=named):
        source.connect()
    source.close()


def test_closing_twice_and_connecting_again_are_fine(stage: Stage) -> None:
    stage.source.close()
    stage.source.close()
    stage.source.connect()
    assert stage.shows(stage.source.receive(0.0), 0)
