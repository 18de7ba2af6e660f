"""Closed episodes are exported in a process of their own, which ends with whoever started it."""

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from runtime.processes.media import export_jobs as module
from runtime.processes.media.export_jobs import ExportQueue
from runtime.recording.export import export_path
from runtime.recording.files import read_json
from tests.processes import PATIENCE_S
from tests.runtime.recording.test_export import recorded


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("data"))


@pytest.mark.exhaustive
@pytest.mark.slow
def test_a_closed_episode_is_exported_and_one_that_cannot_be_is_logged(folder, tmp_path, caplog):
    exports = ExportQueue(tmp_path)
    exports.submit(folder)
    exports.submit(tmp_path / "absent")
    exports.finish(PATIENCE_S)
    (path,) = (tmp_path / "exports").rglob("*.parquet")
    assert path.stem == folder.name
    assert f"{tmp_path / 'absent'} is no folder" in caplog.text


def test_a_process_that_cannot_be_started_is_logged(folder, tmp_path, monkeypatch, caplog):
    def full(*command, **how):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(module.subprocess, "Popen", full)
    exports = ExportQueue(tmp_path)
    exports.submit(folder)
    exports.finish(PATIENCE_S)
    assert "is not exported: [Errno 11] Resource temporarily unavailable" in caplog.text


def test_of_many_episodes_one_is_exported_at_a_time_in_the_order_they_were_closed(tmp_path, monkeypatch):
    alive, order = [], []

    class Child:
        returncode = 0

        def __init__(self, command, **how):
            alive.append(self)
            order.append(Path(command[4]).name)
            assert len(alive) == 1
            self.stderr = self

        def read(self):
            return ""

        def wait(self):
            alive.remove(self)
            return 0

    monkeypatch.setattr(module.subprocess, "Popen", Child)
    exports = ExportQueue(tmp_path)
    for number in range(20):
        exports.submit(tmp_path / str(number))
    exports.finish(PATIENCE_S)
    assert order == [str(number) for number in range(20)]


@pytest.mark.slow
def test_it_ends_with_its_standard_input(folder, tmp_path):
    """Kept from its work by a lock that we hold, it would wait for ever."""
    folder_of_it = export_path(read_json(folder / "manifest.json"), tmp_path).parent
    folder_of_it.mkdir(parents=True)
    lock = os.open(folder_of_it, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    command = [sys.executable, "-m", "runtime.recording", "export", str(folder), "--to", str(tmp_path)]
    child = subprocess.Popen([*command, "--background"], stdin=subprocess.PIPE, cwd=Path(__file__).parents[4])
    try:
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(3.0)
        assert child.stdin is not None
        child.stdin.close()
        assert child.wait(PATIENCE_S) == 1
    finally:
        child.kill()
        child.wait()
        os.close(lock)
    assert list(folder_of_it.iterdir()) == []
