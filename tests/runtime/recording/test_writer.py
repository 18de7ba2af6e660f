import time
from pathlib import Path

import pytest

from runtime.core.errors import RecordingError
from runtime.recording import writer as writer_module
from runtime.recording.files import AppendFile
from runtime.recording.layout import Layout
from runtime.recording.reader import read_events
from runtime.recording.settings import RecordingSettings
from runtime.recording.tables import SCHEMAS, TableWriter, read_table
from runtime.recording.writer import DiskWriter, ErrorLatch
from tests.processes import PATIENCE_S

from .samples import SETTINGS, manifest, tick

LAYOUT = Layout.from_manifest(manifest())
NEVER = RecordingSettings(min_free_bytes=0, flush_period_s=1.0)


def soon() -> float:
    return time.monotonic() + PATIENCE_S


def steps(folder: Path) -> list[int]:
    return read_table(folder / "ticks.arrow", SCHEMAS["ticks"](LAYOUT)).table.column("step").to_pylist()


def test_the_first_fault_is_told_every_time_and_later_ones_are_noted() -> None:
    faults = ErrorLatch()
    faults.raise_pending()
    assert not faults.told
    faults.report(RecordingError("first"))
    faults.report(RecordingError("second"))
    for _ in range(2):
        with pytest.raises(RecordingError, match="first"):
            faults.raise_pending()
    assert faults.told
    assert faults.first is not None
    assert faults.first.__notes__ == ["second"]


def test_records_and_lines_reach_the_disk_without_being_asked(tmp_path: Path) -> None:
    faults = ErrorLatch()
    writer = DiskWriter(tmp_path, LAYOUT, SETTINGS, [], faults)
    writer.add("ticks", tick(0))
    writer.add_line(b'{"kind": "start"}')
    deadline = soon()
    while (
        not steps(tmp_path) or not read_events(tmp_path / "events.jsonl").lines
    ) and time.monotonic() < deadline:
        time.sleep(0.005)
    assert steps(tmp_path) == [0]
    assert read_events(tmp_path / "events.jsonl").lines == (b'{"kind": "start"}',)
    assert writer.finish(soon())
    assert faults.first is None


def test_finishing_writes_what_waits_and_closes_every_stream(tmp_path: Path) -> None:
    writer = DiskWriter(tmp_path, LAYOUT, NEVER, [], ErrorLatch())
    for step in range(5):
        writer.add("ticks", tick(step))
    assert writer.finish(soon())
    assert steps(tmp_path) == [0, 1, 2, 3, 4]
    assert all(
        read_table(tmp_path / f"{name}.arrow", schema(LAYOUT)).closed for name, schema in SCHEMAS.items()
    )


def test_the_names_of_the_files_are_made_durable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[tuple[Path, int]] = []

    def sync(folder: Path) -> None:
        synced.append((folder, len(list(folder.iterdir()))))

    monkeypatch.setattr(writer_module, "sync_folder", sync)
    assert DiskWriter(tmp_path, LAYOUT, NEVER, [], ErrorLatch()).finish(soon())
    assert synced == [(tmp_path, len(SCHEMAS) + 1)]


def test_a_file_that_somebody_still_writes_is_left_open(tmp_path: Path) -> None:
    kept, other = AppendFile(tmp_path / "kept"), AppendFile(tmp_path / "other")
    writer = DiskWriter(tmp_path, LAYOUT, NEVER, [kept, other], ErrorLatch())
    assert writer.finish(soon(), leave=[kept])
    kept.write(b"still open")
    kept.close()
    assert (tmp_path / "kept").read_bytes() == b"still open"
    with pytest.raises(RecordingError, match="disk error while writing"):
        other.write(b"closed")


def test_a_table_that_fails_does_not_keep_the_others_from_being_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    faults = ErrorLatch()
    writer = DiskWriter(tmp_path, LAYOUT, NEVER, [], faults)
    writer.add("ticks", tick(0))
    writer.add("smoothed", tick(0))
    real = TableWriter.finish

    def failing(self: TableWriter) -> None:
        if self.file.path.name == "rows.arrow":
            raise RuntimeError("surprise")
        real(self)

    monkeypatch.setattr(TableWriter, "finish", failing)
    assert writer.finish(soon())
    assert "surprise" in str(faults.first)
    assert steps(tmp_path) == [0]
    assert read_table(tmp_path / "smoothed.arrow", SCHEMAS["smoothed"](LAYOUT)).closed


def test_a_record_that_no_column_takes_is_a_fault(tmp_path: Path) -> None:
    faults = ErrorLatch()
    writer = DiskWriter(tmp_path, LAYOUT, NEVER, [], faults)
    writer.add("ticks", tick(0, source=object()))
    assert writer.finish(soon())
    assert str(tmp_path) in str(faults.first)


def test_too_little_room_is_found_at_a_flush(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checked = []

    def full(folder: Path, wanted: int) -> None:
        checked.append(wanted)
        raise RecordingError("too little room")

    monkeypatch.setattr(writer_module, "require_room", full)
    faults = ErrorLatch()
    writer = DiskWriter(
        tmp_path, LAYOUT, RecordingSettings(min_free_bytes=7, flush_period_s=0.01), [], faults
    )
    deadline = soon()
    while faults.first is None and time.monotonic() < deadline:
        time.sleep(0.005)
    assert writer.finish(soon())
    assert str(faults.first) == "too little room"
    assert checked[0] == 7


def test_records_that_the_disk_does_not_take_are_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "MOST_WAITING", 1100)
    faults = ErrorLatch()
    writer = DiskWriter(tmp_path, LAYOUT, NEVER, [], faults)
    real = TableWriter.flush
    monkeypatch.setattr(TableWriter, "flush", lambda self: None)
    for step in range(1100):
        writer.add("ticks", tick(step))
    monkeypatch.setattr(TableWriter, "flush", real)
    assert "the disk does not keep up: 1100 records wait for" in str(faults.first)
    assert writer.finish(soon())
    assert steps(tmp_path) == list(range(1100))
