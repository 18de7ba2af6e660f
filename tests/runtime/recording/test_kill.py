"""A recorder that is killed in the middle loses at most the last second."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import runtime
from runtime.recording.reader import open_episode
from runtime.recording.repair import repair
from runtime.recording.scrub import verify_episode

from .samples import CAMERAS, numbers

FPS = 30

RECORDER = """
import sys, time
from pathlib import Path
from samples import SETTINGS, manifest, row, tick
from runtime.recording.episode import EpisodeJournal
from runtime.recording.settings import RecordingSettings

journal = EpisodeJournal(Path(sys.argv[1]), RecordingSettings(min_free_bytes=0))
journal.begin(manifest())
start = time.monotonic()
for k in range(10_000):
    time.sleep(max(0.0, start + k / 30 - time.monotonic()))
    journal.append(row(k))
    for step in range(3 * k, 3 * k + 3):
        journal.append(tick(step))
    journal.append_event({"row": k})
    print(k, flush=True)
"""


@pytest.mark.lab  # its second is a real one
@pytest.mark.parametrize("rows", [76, 100])
def test_a_killed_recorder_loses_at_most_the_last_second(tmp_path: Path, rows: int) -> None:
    paths = [Path(runtime.__file__).parents[1], Path(__file__).parent]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    command = [sys.executable, "-c", RECORDER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as recorder:
        assert recorder.stdout is not None
        for _ in range(rows):
            assert recorder.stdout.readline(), "the recorder ended by itself"
        recorder.kill()
        appended = rows + len(recorder.stdout.read().splitlines())
    assert recorder.returncode == -9
    (folder,) = tmp_path.iterdir()
    report = repair(folder)
    assert report.verdict == "repaired"
    assert report.frames >= appended - FPS
    assert verify_episode(folder).state == "sound"
    episode = open_episode(folder)
    assert episode.rows.column("index").to_pylist() == list(range(report.frames))
    assert episode.ticks.num_rows >= 3 * (appended - FPS)
    assert len(episode.events) >= appended - FPS
    for camera in CAMERAS:
        shown = numbers(episode.videos[camera])
        flags = episode.rows.column(f"repeated.{camera}").to_pylist()
        assert len(shown) >= appended - FPS
        for k in range(report.frames):
            assert shown[k] == (shown[k - 1] if flags[k] else k + 1)
