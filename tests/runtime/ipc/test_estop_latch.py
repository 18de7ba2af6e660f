import errno
import os

import pytest

from runtime.ipc.estop_latch import Latch, Latched


@pytest.fixture
def latch(tmp_path):
    return Latch(tmp_path / "bench-1")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "bench-1" / "estop.json"


def test_a_new_station_is_not_latched(latch):
    assert latch.read() is None


def test_a_latch_outlives_who_set_it(latch, tmp_path):
    latched = latch.set("anna", "arm too low")
    assert (latched.by, latched.why) == ("anna", "arm too low")
    assert Latch(tmp_path / "bench-1").read() == latched


def test_a_released_latch_is_gone_for_the_next_start_too(latch, tmp_path):
    latch.set("anna", "arm too low")
    latch.clear()
    assert Latch(tmp_path / "bench-1").read() is None


def test_releasing_what_is_not_latched_changes_nothing(latch, path):
    latch.set("anna", "arm too low")
    latch.clear()
    latch.clear()
    assert latch.read() is None


@pytest.mark.parametrize("content", [b"", b"{", b"{}", b"null", b"[]", b'"x"', b"\xff", b'{"by": "anna"}'])
def test_a_file_that_cannot_be_read_counts_as_latched(latch, path, content):
    path.parent.mkdir()
    path.write_bytes(content)
    latched = latch.read()
    assert isinstance(latched, Latched)
    assert latched.by == "unknown"
    assert "cannot be read" in latched.why


def test_a_folder_in_its_place_counts_as_latched(latch, path):
    path.mkdir(parents=True)
    assert latch.read() is not None


def test_a_disk_that_fills_up_while_it_is_written_leaves_it_latched(latch, monkeypatch):
    def full_disk(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full_disk)
        with pytest.raises(OSError, match="No space left"):
            latch.set("anna", "arm too low")
    assert latch.read() is not None
