"""Stations whose joints come from the tabletop's node and one of whose pictures comes from a camera of ours."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import av
import numpy as np
import pytest

from runtime.ipc.session_state import SessionState
from runtime.processes.lockstep.lockstep import Lockstep
from runtime.recording.reader import Episode, open_episode
from runtime.standins import demo
from runtime.standins.rtsp_server import RtspServer
from tests.runtime.cameras.movies import movie, number_of
from tests.runtime.lockstep_station import column
from tests.runtime.simulation.tabletop_station import served

CAMERA = "cam_high"
RECORDED = ["recording.enabled=true", "recording.min_free_bytes=0"]


def ready(station: Lockstep) -> None:
    session = station.coordinator.session
    station.connect()
    station.until(lambda: session.state is not SessionState.DISCONNECTED, 5.0, "first observation")
    station.command("setup")
    station.until(lambda: session.state is not SessionState.SETTING_UP, 60.0, "set-up")
    assert session.state is SessionState.READY, session.reason


def go(station: Lockstep, seconds: float) -> None:
    end = station.clock.now() + seconds
    station.until(lambda: station.clock.now() >= end, seconds + 1, "ticks")


def stop(station: Lockstep) -> Episode:
    station.command("stop")
    go(station, 0.2)
    return open_episode(Path(station.coordinator.runs.last_episode["path"]))


def shown(episode: Episode) -> list[int]:
    with av.open(str(episode.videos[CAMERA])) as container:
        return [number_of(frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]


def file_camera(path: Path, **settings: str) -> list[str]:
    table = {"kind": "file", "path": str(path), **settings}
    return [f'cameras.{CAMERA}.{key}="{value}"' for key, value in table.items()]


@pytest.mark.exhaustive
def test_a_video_is_recorded_at_its_own_pace_beside_the_nodes_joints(tmp_path: Path) -> None:
    film = movie(tmp_path / "film.mp4", pictures=10, rate=10, size=(640, 480))
    with served("tabletop", 1, tmp_path, [*RECORDED, *file_camera(film)]) as (_, station):
        ready(station)
        station.command("run")
        go(station, 2.0)
        status = station.coordinator.snapshot()["link"]["cameras"][CAMERA]
        assert (status["kind"], status["condition"], status["losses"]) == ("file", "live", 0)
        episode = stop(station)
        assert station.spec.cameras == tuple(episode.videos), "all others come from the node"
    captured = column(episode.rows, f"capture_time.{CAMERA}")
    joints = column(episode.rows, "capture_time.joints")
    repeated = column(episode.rows, f"repeated.{CAMERA}")
    played = np.unique(captured)[1:]  # the first tick may have seen the picture that stood before
    assert len(played) > 15
    np.testing.assert_allclose(np.diff(played), 0.1, atol=1e-6)
    assert ((joints - captured >= -1e-6) & (joints - captured < 0.1 + 1e-6)).all()
    np.testing.assert_array_equal(~repeated[1:].astype(bool), np.diff(captured) > 0)
    numbers = shown(episode)
    assert numbers[0] == 0
    assert set(numbers) == set(range(10))


@pytest.mark.exhaustive
def test_a_camera_that_ends_in_a_run_is_named_refuses_the_policy_and_recording_goes_on(
    tmp_path: Path,
) -> None:
    film = movie(tmp_path / "film.mp4", pictures=10, rate=10, size=(640, 480))
    given = [*RECORDED, *file_camera(film, at_end="stop"), "safety.picture_age_s=0.5"]
    with served("tabletop", 1, tmp_path, given) as (_, station):
        ready(station)
        station.command("run")
        go(station, 6.0)
        assert station.coordinator.session.state is SessionState.HOLDING
        held = station.coordinator.session.reason
        rows = station.coordinator.snapshot()["recording"]["rows"]
        go(station, 1.0)
        assert station.coordinator.snapshot()["recording"]["rows"] > rows, "recording goes on"
        episode = stop(station)
        events = station.coordinator.events.since(0)
        assert [event["text"] for event in events if event["kind"] == "camera_ended"] == [
            f"camera {CAMERA} ({film}) is ended: the file is over"
        ]
        go(station, 0.5)
        assert station.coordinator.snapshot()["link"]["cameras"][CAMERA]["condition"] == "live", (
            "it stands again"
        )
    assert CAMERA in held
    captured = column(episode.rows, f"capture_time.{CAMERA}")
    repeated = column(episode.rows, f"repeated.{CAMERA}").astype(bool)
    played = np.unique(captured)[-10:]
    np.testing.assert_allclose(np.diff(played), 0.1, atol=1e-6)
    assert repeated[captured == captured.max()][1:].all()


def test_a_camera_that_cannot_be_opened_is_named_while_the_station_waits_for_it(tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    with served("tabletop", 1, tmp_path, file_camera(film)) as (_, station):
        session = station.coordinator.session
        station.connect()
        go(station, 1.0)
        assert session.state is SessionState.DISCONNECTED
        why = f"camera {CAMERA} ({film}) is opening: there is no such file"
        assert session.reason == f"no picture has arrived from {CAMERA}; {why}"
        said = [
            event["text"] for event in station.coordinator.events.since(0) if event["kind"] == "camera_absent"
        ]
        assert said == [f"camera {CAMERA} ({film}): there is no such file"]


def test_the_set_up_fails_by_name_where_a_camera_is_gone(tmp_path: Path) -> None:
    film = movie(tmp_path / "film.mp4", size=(640, 480))
    with served("tabletop", 1, tmp_path, [*file_camera(film), "setup.observation_timeout_s=1.0"]) as (
        _,
        station,
    ):
        ready(station)
        film.write_bytes(b"overwritten")
        station.command("run")
        go(station, 0.5)
        station.command("stop")
        go(station, 0.5)
        station.command("setup")
        session = station.coordinator.session
        station.until(lambda: session.state is not SessionState.SETTING_UP, 10.0, "set-up")
        assert session.state is not SessionState.READY
        assert f"camera {CAMERA} ({film}) is lost: not a video" in session.reason


@pytest.mark.lab
@pytest.mark.slow
def test_a_real_station_runs_with_a_camera_over_rtsp(tmp_path: Path) -> None:
    """Processes, node, policy server and camera are all real but for the robot."""
    with closing(RtspServer(640, 480)) as server:
        url = server.start()
        table = {"kind": "rtsp", "url": url}
        sets = [f'cameras.{CAMERA}.{key}="{value}"' for key, value in table.items()]
        result = tmp_path / "result.json"
        patience = [  # the test's machine may be busy
            "safety.joint_age_s=10.0",
            "safety.picture_age_s=10.0",
            "control.starvation_hold_s=10.0",
            "control.heartbeat_timeout_s=10.0",
            "control.coordinator_timeout_s=10.0",
        ]
        given = [f'data_dir="{tmp_path}"', "run.duration_s=4.0", *sets, *patience]
        options = [part for one in given for part in ("--set", one)]
        assert demo.main(["--once", "--json", str(result), *options]) == 0
        assert server.sent > 30
    (folder,) = [path for path in (tmp_path / "episodes").iterdir() if path.is_dir()]
    episode = open_episode(folder)
    told = json.loads(result.read_text("utf-8"))
    captured = column(episode.rows, f"capture_time.{CAMERA}")
    ages = column(episode.rows, "capture_time.joints") - captured
    assert (np.diff(captured) >= 0).all()
    assert len(set(captured)) > len(captured) / 4, told
    assert -0.5 < np.median(ages) < 0.5
    with av.open(str(episode.videos[CAMERA])) as container:
        picture = next(container.decode(video=0)).to_ndarray(format="rgb24")
    np.testing.assert_allclose(picture[100, 100], (220, 0, 0), atol=15)
    np.testing.assert_allclose(picture[100, -100], (0, 0, 220), atol=15)
