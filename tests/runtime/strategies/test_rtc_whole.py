"""Real-time chunking through the assembled runtime: strategy, commitment, a dialect on a real socket, the record."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from runtime.core.types import Float32, Float64, UInt8
from runtime.ipc.session_state import SessionState
from runtime.simulation.scripts.script import Answer, Script
from runtime.standins.openpi_server import Behaviour, OpenpiServer
from tests.runtime.lockstep_station import MOVED, STANDS, Station, column, stubbed

HORIZON, DELAY = 16, 4


class Wavering(Script):
    """Changes its mind with every answer: the same pose, to one side and to the other."""

    metadata: Mapping[str, object] = {"name": "wavering", "action_horizon": HORIZON}

    def begin(self) -> Answer:
        side = itertools.cycle((-0.04, 0.04))

        def answer(q: Float64, pictures: Mapping[str, UInt8], prompt: str) -> Float32:
            rows = np.tile(STANDS, (HORIZON, 1)).astype(np.float32)
            rows[:, MOVED] += next(side)
            return rows

        return answer


@dataclass
class Log:
    """What the server was asked and answered, in order."""

    asked: list[dict[str, Any]] = field(default_factory=list)
    answered: list[dict[str, Any]] = field(default_factory=list)

    def listen(self, server: OpenpiServer) -> None:
        wire = server._wire
        read, answer = wire.read, wire.answer

        def reading(message: Any) -> Any:
            self.asked.append(message)
            return read(message)

        def answering(result: dict[str, object], asked: Any) -> bytes:
            self.answered.append(result)
            return answer(result, asked)

        wire.read, wire.answer = reading, answering  # type: ignore[method-assign]


@contextlib.contextmanager
def wired(
    tmp_path: Path, dialect: str, strategy: str, served: str = "", log: Log | None = None, **settings: Any
) -> Iterator[Station]:
    bare = stubbed(tmp_path)
    server = OpenpiServer(bare.spec.robot, Behaviour(HORIZON, 30.0, rtc=served or dialect), 0, Wavering())
    if log is not None:
        log.listen(server)
    if dialect == "openpi_rtc":
        settings = {"rtc_envelope": {"server_shift": HORIZON // 2}, **settings}
    with contextlib.closing(server):
        made = stubbed(
            tmp_path,
            strategy=strategy,
            delay=DELAY,
            real="openpi",
            policy={
                "kind": "openpi",
                "url": server.start()["url"],
                "rtc": dialect,
                "image_size": [16, 16],
                **settings,
            },
        )
        station = Station(made)
        yield station
        station.close()


def chunks(station: Station) -> list[tuple[int, np.ndarray]]:
    """(observation step, rows [H, D]) of every chunk that was merged."""
    raw = station.stop().raw
    steps, actions = column(raw, "observation_step"), column(raw, "action")
    assert len(actions) % HORIZON == 0
    return [(int(steps[at]), actions[at : at + HORIZON]) for at in range(0, len(actions), HORIZON)]


def seams(station: Station) -> np.ndarray:
    """How far each chunk is, at the step it arrived, from what the one before it wanted then [rad]."""
    found = chunks(station)
    assert len(found) > 8
    return np.array(
        [
            np.abs(new[DELAY] - old[step - before + DELAY]).max()
            for (before, old), (step, new) in itertools.pairwise(found)
            if step - before + DELAY < HORIZON
        ]
    )


@pytest.mark.some(2)
@pytest.mark.parametrize("dialect", ["prev_action", "openpi_rtc", "kai0", "async_rtc"])
def test_a_chunk_continues_what_the_robot_is_committed_to_whatever_the_policy_would_rather(
    tmp_path: Path, dialect: str
) -> None:
    with wired(tmp_path, dialect, "rtc") as station:
        station.running(90)
        assert station.state is SessionState.RUNNING, station.reason
        told = station.coordinator.snapshot()["policy"]["rtc"]
        assert (told["conditioned"], told["predicted_delay"]) == (True, DELAY)
        assert seams(station).max() < 0.015  # of the 0.08 that it wavers


def test_without_it_the_same_policy_wavers(tmp_path: Path) -> None:
    with wired(tmp_path, "prev_action", "async") as station:
        station.running(90)
        assert np.median(seams(station)) == pytest.approx(0.08, abs=1e-3)


def test_a_policy_that_does_not_speak_it_is_refused_at_set_up_and_when_it_is_tuned_to(tmp_path: Path) -> None:
    with wired(tmp_path, "none", "rtc") as station:
        station.prepare()
        assert station.state is SessionState.IDLE
        assert "does not continue a chunk" in station.reason
    with wired(tmp_path, "none", "async") as station:
        station.running(10)
        with pytest.raises(Exception, match="does not continue a chunk"):
            station.command("tune", strategy={"kind": "rtc"})
        station.go(10)
        assert station.state is SessionState.RUNNING


# What each dialect sends, row by row


class Requests(NamedTuple):
    """Of one run: what was asked second and later, the answer before each, and the rows consumed of that one."""

    asked: list[dict[str, Any]]
    before: list[dict[str, Any]]
    consumed: list[int]


def asked_in_a_run(tmp_path: Path, dialect: str, **settings: Any) -> Requests:
    log = Log()
    with wired(tmp_path, dialect, "rtc", log=log, **settings) as station:
        station.ready()
        warm = len(log.asked)
        station.command("run")
        station.go(60)
        assert station.state is SessionState.RUNNING, station.reason
        steps = [step for step, _ in chunks(station)]
    assert len(steps) > 6
    asked, answered = log.asked[warm : warm + len(steps)], log.answered[warm : warm + len(steps)]
    for message in (*log.asked[:warm], asked[0]):  # nothing is committed yet
        assert not {"prev_action", "rtc_params", "prev_action_chunk"} & set(message)
        assert not message.get("is_rtc")
        assert message.get("rtc") is None
    return Requests(asked[1:], answered[:-1], np.diff(steps).tolist())


def test_prev_action_is_what_is_left_held_to_its_length(tmp_path: Path) -> None:
    for asked, before, consumed in zip(*asked_in_a_run(tmp_path, "prev_action"), strict=True):
        rows = before["origin_actions"]
        expected = rows[np.minimum(np.arange(HORIZON) + consumed, HORIZON - 1)]
        np.testing.assert_array_equal(asked["prev_action"], expected)
        assert asked["rtc_params"] == {"s": consumed}


def test_openpi_rtc_begins_where_the_robot_is_once_the_server_has_taken_its_rows_off(tmp_path: Path) -> None:
    requests = asked_in_a_run(tmp_path, "openpi_rtc")
    shift = HORIZON // 2
    for asked, before, consumed in zip(*requests, strict=True):
        assert set(asked) == {"obs", "prev_action", "is_rtc"}
        assert asked["is_rtc"] is True
        assert asked["prev_action"].shape == (HORIZON, 32)
        left = before["origin_actions"][consumed:]
        seen = asked["prev_action"][shift:]
        count = min(len(left), len(seen))
        np.testing.assert_array_equal(seen[:count], left[:count])
        assert (seen[count:] == left[-1]).all()
    assert any(consumed != shift for consumed in requests.consumed)


def test_openpi_rtc_is_sent_the_chunk_as_it_was_where_that_is_wanted(tmp_path: Path) -> None:
    for asked, before, _ in zip(*asked_in_a_run(tmp_path, "openpi_rtc", rtc_rows="whole"), strict=True):
        np.testing.assert_array_equal(asked["prev_action"], before["origin_actions"])


def test_kai0_is_sent_what_is_left_in_the_robots_numbers_and_the_measured_delay(tmp_path: Path) -> None:
    for asked, before, consumed in zip(*asked_in_a_run(tmp_path, "kai0"), strict=True):
        rows = asked["prev_action_chunk"]
        assert (len(rows), {len(row) for row in rows}, type(rows[0][0])) == (HORIZON, {32}, float)
        expected = before["actions"][np.minimum(np.arange(HORIZON) + consumed, HORIZON - 1)]
        np.testing.assert_array_equal(np.array(rows, np.float32)[:, :14], expected)
        assert not np.array(rows)[:, 14:].any()
        assert asked["inference_delay"] == DELAY
        assert asked["execute_horizon"] == HORIZON - consumed


def test_kai0_is_sent_the_chunk_where_it_was_where_that_is_wanted(tmp_path: Path) -> None:
    """Its server begins anew with each answer then, so each is blended in: what was blended is sent as it became."""
    blended = slice(DELAY, DELAY + 8)
    for asked, before, _ in zip(*asked_in_a_run(tmp_path, "kai0", rtc_rows="whole"), strict=True):
        rows = np.array(asked["prev_action_chunk"], np.float32)[:, :14]
        np.testing.assert_array_equal(
            np.delete(rows, blended, axis=0), np.delete(before["actions"], blended, axis=0)
        )
        assert asked["execute_horizon"] == HORIZON


def test_async_rtc_is_sent_what_is_left_and_no_more(tmp_path: Path) -> None:
    for asked, before, consumed in zip(*asked_in_a_run(tmp_path, "async_rtc"), strict=True):
        rtc = asked["rtc"]
        np.testing.assert_array_equal(rtc["prev_chunk_left_over"], before["origin_actions"][consumed:])
        assert (rtc["inference_delay"], rtc["execution_horizon"]) == (DELAY, HORIZON)
