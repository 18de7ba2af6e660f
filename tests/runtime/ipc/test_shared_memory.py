import mmap
import multiprocessing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.core.errors import RuntimeFault
from runtime.ipc.shared_memory import Record, Ring, TornReadError

DTYPE = np.dtype([("a", "i8"), ("b", "f4", 7)])


def record() -> Record:
    return Record(mmap.mmap(-1, Record.size(DTYPE)), 0, DTYPE)


def test_a_record_that_cannot_be_read_whole_is_a_fault_that_main_can_tell():
    memory = mmap.mmap(-1, Record.size(DTYPE))
    torn = Record(memory, 0, DTYPE)
    torn.write(value(7))
    memory[: Record.size(DTYPE)] = memory[:8] + bytes(Record.size(DTYPE) - 8)  # all but its version
    with pytest.raises(TornReadError, match="could not be read in 100 tries") as torn_error:
        torn.read()
    assert isinstance(torn_error.value, RuntimeFault)


def ring(capacity: int) -> Ring:
    return Ring(mmap.mmap(-1, Ring.size(capacity)), 0, capacity)


def value(number: int) -> np.void:
    made = np.zeros((), DTYPE)
    made["a"], made["b"] = number, number
    return made[()]


def test_a_record_never_written_reads_as_zeros():
    assert record().read()["a"] == 0
    assert record().version == 0


def test_a_record_reads_back_what_was_written_last():
    shared = record()
    for number in range(1, 6):
        shared.write(value(number))
        assert shared.read()["a"] == number
        assert (shared.read()["b"] == number).all()


def test_a_writer_cut_off_in_the_middle_leaves_the_last_record_readable():
    shared = record()
    shared.write(value(1))
    # The next write goes to the other half; scribble over it as a killed writer would have.
    start = shared._offset + 64 + (2 & 1) * shared._slot
    shared._memory[start : start + 20] = b"\xff" * 20
    assert shared.read()["a"] == 1


def test_what_is_not_published_yet_is_not_read_by_who_was_kept_waiting(monkeypatch):
    """Else the next reading would be older than this one."""
    shared = record()
    for number in range(1, 4):
        shared.write(value(number))
    shared._version[0] = (
        2  # the third is whole in the half of the first, and its writer has not come to say so
    )
    seen = iter([1])
    monkeypatch.setattr(Record, "version", property(lambda self: next(seen, int(self._version[0]))))
    assert shared.read()["a"] == 2


def _write_many(shared: Record, count: int) -> None:
    for number in range(1, count + 1):
        shared.write(value(number))


def test_a_reader_in_another_process_never_sees_a_torn_record():
    shared = record()
    writer = multiprocessing.get_context("fork").Process(target=_write_many, args=(shared, 20_000))
    writer.start()
    newest = 0
    while newest < 20_000:
        seen = shared.read()
        assert (seen["b"] == np.float32(seen["a"])).all()
        assert seen["a"] >= newest
        newest = int(seen["a"])
    writer.join()


@given(st.lists(st.binary(max_size=60), max_size=60), st.integers(100, 300), st.integers(1, 7))
def test_a_ring_gives_back_every_accepted_message_in_order(messages, capacity, burst):
    queue = ring(capacity)
    accepted, got = [], []
    for index, message in enumerate(messages):
        if queue.push(message):
            accepted.append(message)
        if index % burst == 0:
            got.extend(queue.drain())
    got.extend(queue.drain())
    assert got == accepted
    assert queue.refused == len(messages) - len(accepted)


def test_a_full_ring_refuses_and_keeps_what_it_has():
    queue = ring(64)
    assert queue.push(b"x" * 40)
    assert not queue.push(b"y" * 40)
    assert list(queue.drain()) == [b"x" * 40]
    assert queue.push(b"y" * 40)
