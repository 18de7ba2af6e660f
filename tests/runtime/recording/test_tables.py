import errno
import os
from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import RecordingError
from runtime.recording.columns import RecordedRow
from runtime.recording.layout import Layout
from runtime.recording.tables import (
    END_OF_STREAM,
    SCHEMAS,
    TableWriter,
    read_table,
    rows_schema,
    write_table,
)

from .samples import manifest, row, tick

LAYOUT = Layout.from_manifest(manifest())
SCHEMA = rows_schema(LAYOUT)
BATCHES = (3, 1, 5, 2)


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[int]]:
    """A whole rows.arrow, and where each batch ends."""
    folder = tmp_path_factory.mktemp("stream")
    writer = TableWriter(folder, "rows", LAYOUT)
    ends, index = [writer.file.size], 0
    for size in BATCHES:
        for _ in range(size):
            writer.add(RecordedRow(row(index), frozenset()))
            index += 1
        writer.flush()
        ends.append(writer.file.size)
    writer.finish()
    writer.file.close()
    return (folder / "rows.arrow").read_bytes(), ends


@given(data=st.data())
def test_a_cut_at_any_byte_loses_only_whole_batches_at_the_end(
    tmp_path_factory: pytest.TempPathFactory, stream: tuple[bytes, list[int]], data: st.DataObject
) -> None:
    whole, ends = stream
    cut = data.draw(st.integers(0, len(whole)))
    path = tmp_path_factory.getbasetemp() / "cut" / "rows.arrow"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(whole[:cut])
    read = read_table(path, SCHEMA)
    survivors = sum(end <= cut for end in ends[1:])
    assert read.table.column("index").to_pylist() == list(range(sum(BATCHES[:survivors])))
    assert read.closed == (cut == len(whole))
    if cut >= ends[0]:
        assert read.torn_bytes == (0 if read.closed else cut - ends[survivors])
    else:
        assert read.torn_bytes == cut


@given(data=st.data())
def test_zeros_in_the_place_of_the_tail_never_become_rows(
    tmp_path_factory: pytest.TempPathFactory, stream: tuple[bytes, list[int]], data: st.DataObject
) -> None:
    whole, ends = stream
    cut = data.draw(st.integers(ends[1], len(whole)))
    path = tmp_path_factory.getbasetemp() / "zeros" / "rows.arrow"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(whole[:cut] + bytes(len(whole) - cut))
    indices = read_table(path, SCHEMA).table.column("index").to_pylist()
    assert indices == list(range(len(indices)))
    assert len(indices) >= sum(BATCHES[: sum(end <= cut for end in ends[1:])])


def test_any_arrow_reader_reads_a_whole_stream(stream: tuple[bytes, list[int]]) -> None:
    whole, ends = stream
    assert pa.ipc.open_stream(whole).read_all().num_rows == sum(BATCHES)
    assert pa.ipc.open_stream(whole[: ends[2]]).read_all().num_rows == sum(BATCHES[:2])


def test_an_absent_table_is_empty_and_has_its_columns(tmp_path: Path) -> None:
    read = read_table(tmp_path / "rows.arrow", SCHEMA)
    assert read.table.num_rows == 0
    assert read.table.schema == SCHEMA
    assert not read.closed


def test_rows_after_a_gap_are_not_read(tmp_path: Path) -> None:
    writer = TableWriter(tmp_path, "rows", LAYOUT)
    for index in (0, 1, 3):
        writer.add(RecordedRow(row(index), frozenset()))
        writer.flush()
    writer.finish()
    writer.file.close()
    assert read_table(tmp_path / "rows.arrow", SCHEMA).table.column("index").to_pylist() == [0, 1]


def test_other_columns_than_the_manifest_says_are_named(tmp_path: Path) -> None:
    write_table(tmp_path / "rows.arrow", SCHEMAS["ticks"](LAYOUT).empty_table())
    with pytest.raises(RecordingError, match=r"other columns than its manifest says: .*planned"):
        read_table(tmp_path / "rows.arrow", SCHEMA)


def test_a_table_written_whole_is_closed(tmp_path: Path, stream: tuple[bytes, list[int]]) -> None:
    table = pa.ipc.open_stream(stream[0]).read_all()
    write_table(tmp_path / "rows.arrow", table.slice(0, 4))
    read = read_table(tmp_path / "rows.arrow", SCHEMA)
    assert (read.table.num_rows, read.closed, read.torn_bytes) == (4, True, 0)
    assert (tmp_path / "rows.arrow").read_bytes().endswith(END_OF_STREAM)


def test_what_a_full_disk_refused_is_written_at_the_next_attempt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = TableWriter(tmp_path, "ticks", LAYOUT)
    writer.add(tick(0))

    def full(descriptor: int, data: memoryview) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(RecordingError, match=r"disk full while writing .*ticks\.arrow"):
        writer.flush()
    monkeypatch.undo()
    writer.add(tick(1))
    writer.finish()
    writer.file.close()
    read = read_table(tmp_path / "ticks.arrow", SCHEMAS["ticks"](LAYOUT))
    assert read.table.column("step").to_pylist() == [0, 1]
    assert read.closed


# raw.arrow as it was before chunks said which strategy merged them: written out, so that it stays as it was.
RAW_OF_OLD = pa.schema(
    [
        ("chunk_id", pa.int64()),
        ("observation_step", pa.int64()),
        ("arrival_step", pa.int64()),
        ("index", pa.int64()),
        ("target_step", pa.int64()),
        ("action", pa.list_(pa.float32())),
        ("space", pa.string()),
        ("delay", pa.int64()),
        ("mistimed", pa.int64()),
        ("inference_ms", pa.float64()),
    ]
)


def old_raw(path: Path, rows: int = 4) -> bytes:
    """An older raw.arrow of one chunk, in two batches; returns its bytes."""
    table = pa.table(
        {
            "chunk_id": [1] * rows,
            "observation_step": [10] * rows,
            "arrival_step": [11] * rows,
            "index": list(range(rows)),
            "target_step": [-1, *range(11, 10 + rows)],
            "action": [[0.5, 1.5]] * rows,
            "space": ["joint"] * rows,
            "delay": [1] * rows,
            "mistimed": [0] * rows,
            "inference_ms": [42.0] * rows,
        },
        RAW_OF_OLD,
    )
    write_table(path, pa.Table.from_batches([*table.slice(0, 2).to_batches(), *table.slice(2).to_batches()]))
    return path.read_bytes()


def test_what_older_files_do_not_say_is_not_known(tmp_path: Path) -> None:
    old_raw(tmp_path / "raw.arrow")
    read = read_table(tmp_path / "raw.arrow", SCHEMAS["raw"](LAYOUT))
    assert read.closed
    assert read.table.schema.equals(SCHEMAS["raw"](LAYOUT))
    assert read.table["target_step"].to_pylist() == [-1, 11, 12, 13]
    assert read.table["strategy"].to_pylist() == read.table["overlap"].to_pylist() == [None] * 4


def test_an_older_file_that_was_cut_off_keeps_its_whole_batches(tmp_path: Path) -> None:
    path = tmp_path / "raw.arrow"
    whole = old_raw(path)
    path.write_bytes(whole[: len(whole) - 40])
    read = read_table(path, SCHEMAS["raw"](LAYOUT))
    assert read.table["index"].to_pylist() == [0, 1]
    assert not read.closed
    assert read.torn_bytes > 0


def test_older_columns_in_another_order_are_still_refused(tmp_path: Path) -> None:
    old_raw(tmp_path / "raw.arrow")
    table = pa.ipc.open_stream((tmp_path / "raw.arrow").read_bytes()).read_all()
    write_table(tmp_path / "raw.arrow", table.select([*table.column_names[1:], table.column_names[0]]))
    with pytest.raises(RecordingError, match="other columns than its manifest says"):
        read_table(tmp_path / "raw.arrow", SCHEMAS["raw"](LAYOUT))
