"""A whole trial in lockstep over a recording, for every version of the format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.config import loader
from runtime.core.errors import TransportError
from runtime.datasets.publishing import publish
from runtime.datasets.reader import open_dataset
from runtime.ipc.session_state import SessionState
from runtime.processes.lockstep import lockstep
from runtime.recording.reader import Episode, open_episode
from runtime.station import spec as station_spec
from runtime.station.checks import check_deployment
from tests.runtime.datasets.foreign import Plan, column, shown, write
from tests.runtime.datasets.small import seen

FPS, LENGTHS, EPISODE = 30.0, (20, 35, 11), 1
WIDTHS = {"joints": 14, "action": 14}
CAMERAS = ("cam_high", "cam_left_wrist", "cam_right_wrist")
VERSIONS = ("v2.0", "v2.1", "v3.0")


def foreign(root: Path, version: str, fps: float = FPS) -> Plan:
    spec = Plan(version, lengths=LENGTHS, fps=fps, videos=CAMERAS, widths=WIDTHS, smooth=True)
    write(root, spec)
    return spec


def trial(tmp_path: Path, **tables: Any) -> station_spec.StationSpec:
    mapping = {"state": "joints", "action": "action"}
    place = {"path": str(tmp_path / "set"), "episode": EPISODE, "mapping": mapping}
    tree = {
        "station": "bench",
        "robot": "agilex_piper",
        "data_dir": str(tmp_path / "data"),
        "task": "stack the cups",
        "transport": {"kind": "dataset", **place},
        "policy": {"kind": "replay", **place, "horizon": 8},
        "strategy": {"kind": "sync"},
        "setup": {"home": False},
        "safety": {"report_only": True},
        "recording": {"min_free_bytes": 0},
        **tables,
    }
    return check_deployment(loader.resolve_deployment(tree, {}, "test"))


def stacked(table: Any, name: str) -> np.ndarray:
    return np.array(table[name].to_pylist(), np.float32)


def played(episode: Episode) -> dict[str, list[int]]:
    numbers = {}
    for camera, path in episode.videos.items():
        from runtime.datasets.video_frames import VideoFrames

        with VideoFrames(path) as pictures:
            numbers[camera] = [seen(pictures[k]) for k in range(episode.frames)]
    return numbers


@pytest.mark.some(1)
@pytest.mark.parametrize("version", VERSIONS)
def test_every_frame_is_observed_once_and_every_recorded_action_is_executed(
    tmp_path: Path, version: str
) -> None:
    spec = foreign(tmp_path / "set", version)
    done = lockstep.run(trial(tmp_path))
    assert (done.state, done.reason) == (SessionState.READY, "the recording that is the source has ended")
    episode, length = open_episode(Path(done.episode["path"])), LENGTHS[EPISODE]
    assert episode.frames == length
    assert np.array_equal(stacked(episode.rows, "qpos"), column(EPISODE, "joints", length, spec))
    assert np.array_equal(stacked(episode.ticks, "executed"), column(EPISODE, "action", length, spec))
    wanted = [shown(EPISODE, k) for k in range(length)]
    assert played(episode) == dict.fromkeys(CAMERAS, wanted)
    assert episode.manifest["task"] == "stack the cups"


@pytest.mark.exhaustive
def test_a_trial_of_v30_is_published_as_v30_and_played_again(tmp_path: Path) -> None:
    spec = foreign(tmp_path / "set", "v3.0")
    done = lockstep.run(trial(tmp_path))
    publish(Path(done.episode["path"]), tmp_path / "again", version="v3.0")
    again = {
        "kind": "dataset",
        "path": str(tmp_path / "again"),
        "mapping": {"eef": "eef_state", "velocity": "joint_velocity"}
        if "joint_velocity" in open_dataset(tmp_path / "again").features
        else {"eef": "eef_state"},
    }
    policy = {"kind": "replay", "path": str(tmp_path / "again"), "horizon": 8}
    twice = lockstep.run(trial(tmp_path, transport=again, policy=policy))
    assert twice.state is SessionState.READY, twice.reason
    episode, length = open_episode(Path(twice.episode["path"])), LENGTHS[EPISODE]
    assert np.array_equal(stacked(episode.rows, "qpos"), column(EPISODE, "joints", length, spec))
    assert np.array_equal(stacked(episode.ticks, "executed"), column(EPISODE, "action", length, spec))


@pytest.mark.some(1)
@pytest.mark.parametrize("version", VERSIONS)
def test_a_recording_slower_than_control_is_paced_by_its_own_rate(tmp_path: Path, version: str) -> None:
    foreign(tmp_path / "set", version, fps=12.5)
    done = lockstep.run(trial(tmp_path, control={"rate": 50.0}, recording={"fps": 50.0, "min_free_bytes": 0}))
    assert done.state is SessionState.READY, done.reason
    episode, length = open_episode(Path(done.episode["path"])), LENGTHS[EPISODE]
    assert episode.frames == 4 * (length - 1) + 1
    wanted = [shown(EPISODE, k // 4) for k in range(episode.frames)]
    assert played(episode) == dict.fromkeys(CAMERAS, wanted)


def test_the_mock_policy_moves_over_a_recording_without_a_server(tmp_path: Path) -> None:
    foreign(tmp_path / "set", "v3.0")
    done = lockstep.run(trial(tmp_path, policy={"kind": "mock"}, strategy={"kind": "async"}))
    assert (done.state, done.reason) == (SessionState.READY, "the recording that is the source has ended")
    episode = open_episode(Path(done.episode["path"]))
    sent = stacked(episode.ticks, "executed")
    assert len(sent) == LENGTHS[EPISODE]
    assert np.ptp(sent, axis=0).max() > 0.01


def test_a_video_that_breaks_off_ends_the_set_up_with_its_name(tmp_path: Path) -> None:
    foreign(tmp_path / "set", "v3.0")
    broken = tmp_path / "set/videos/observation.images.cam_left_wrist/chunk-000/file-000.mp4"
    broken.write_bytes(b"")
    with pytest.raises(TransportError, match=f"{broken} cannot be opened as a video"):
        lockstep.run(trial(tmp_path))
