"""Stops on their way into the records."""

from __future__ import annotations

import errno
import itertools
from pathlib import Path
from uuid import uuid4

import pytest
from django.contrib.auth.models import User
from django.db import OperationalError

from evaweb.stations import stop_recorder as module
from evaweb.stations.models import Command, CommandStatus, Station
from evaweb.stations.stop_recorder import StopRecorder
from tests.processes import PATIENCE_S, eventually


class Quiet(StopRecorder):
    """One whose thread is the test."""

    def __init__(self, keep, **more):
        self.now = 0.0
        super().__init__(keep, clock=lambda: self.now, **more)

    def _run_soon(self):
        pass


@pytest.fixture
def kept():
    return []


@pytest.fixture
def quiet(kept):
    return Quiet(kept.append)


def halted(user="ann", station="bench-1", pk=1, status=CommandStatus.ACCEPTED):
    at = Station(pk=pk, name=station)
    return Command(uuid=uuid4(), station=at, user=User(username=user), kind="halt", status=status)


def test_the_first_is_written_at_once_and_a_flood_is_counted(quiet, kept):
    first = halted()
    quiet.record(first)
    assert quiet.write_due() is None
    flood = [halted() for _ in range(5000)]
    for row in flood:
        quiet.record(row)
    assert quiet.write_due() == 1.0
    assert kept == [first]
    quiet.now = 1.0
    assert quiet.write_due() is None
    assert kept == [first, flood[-1]]
    assert (first.data, flood[-1].data) == ({}, {"times": 5000})


def test_what_differs_is_written_each_for_itself(quiet, kept):
    rows = [
        halted(),
        halted(user="bob"),
        halted(station="bench-2"),
        halted(status=CommandStatus.REFUSED),
    ]
    for row in rows:
        quiet.record(row)
    quiet.write_due()
    assert kept == rows


def test_no_press_that_latched_is_only_counted_with_those_that_came_after_it(quiet, kept):
    rows = [halted(status=CommandStatus.DONE) for _ in range(4)]
    for row, how, at in zip(rows, ("anew", "already", "anew", "already"), (1.0, 2.0, 3.0, 4.0), strict=True):
        row.kind, row.data = "estop", {"latched": how, "carried_out_at": at}
        quiet.record(row)
    quiet.write_due()
    assert [row.data["carried_out_at"] for row in kept if row.data["latched"] == "anew"] == [1.0, 3.0]


def test_the_end_of_the_process_waits_for_no_second(quiet, kept):
    for _ in range(3):
        quiet.record(halted())
        quiet.write_due()
    assert len(kept) == 1
    quiet.write_due(all_of_them=True)
    assert kept[1].data == {"times": 2}


def test_one_that_cannot_be_kept_keeps_no_other_from_it(kept, caplog):
    def keep(row):
        if row.user.username == "ann":
            raise OperationalError("gone")
        kept.append(row)

    quiet = Quiet(keep)
    for row in (halted(), halted(user="bob")):
        quiet.record(row)
    quiet.write_due()
    assert [row.user.username for row in kept] == ["bob"]
    assert "is not written down" in caplog.text


def test_one_that_cannot_be_kept_now_is_tried_again_with_those_that_came_since(kept, caplog):
    def keep(row):
        if quiet.now < 2:
            raise OperationalError("gone")
        kept.append(row)

    quiet = Quiet(keep)
    quiet.record(halted())
    assert quiet.write_due() == 1.0
    last = halted()
    quiet.record(last)
    for quiet.now, wait in ((0.5, 0.5), (1.0, 1.0), (2.0, None)):
        assert quiet.write_due() == wait
    assert (kept, last.data) == ([last], {"times": 2})
    assert caplog.text.count("is not written down yet") == 1, "one line for many"


def test_names_that_somebody_made_up_fill_no_disk(quiet, kept, settings, tmp_path, caplog):
    settings.DATA_DIR = tmp_path
    (tmp_path / "stations" / "real").mkdir(parents=True)
    for name in ("made-up", "x" * 300, "nu\0l", "real"):
        quiet.record(halted(station=name, pk=None))
    quiet.write_due()
    assert [row.station.name for row in kept] == ["real"]
    assert "there is no such station" in caplog.text


def test_a_station_that_the_disk_does_not_tell_of_is_one(quiet, kept, monkeypatch):
    def spoiled(path):
        raise OSError(errno.EIO, "Input/output error", str(path))

    monkeypatch.setattr(Path, "is_dir", spoiled)
    rows = [halted(pk=None), halted(user="bob")]
    for row in rows:
        quiet.record(row)
    quiet.write_due()
    assert kept == rows


def test_the_thread_survives_what_nobody_expects_and_keeps_the_note(kept, monkeypatch, caplog):
    times = itertools.count()

    def odd(row):
        if next(times) < 3:
            raise RuntimeError("anything")
        return True

    monkeypatch.setattr(module, "_has_station", odd)
    monkeypatch.setattr(module, "_APART_S", 0.01)
    notes, rows = StopRecorder(kept.append), [halted(), halted(user="bob")]
    for row in rows:
        notes.record(row)
    eventually(
        lambda: sorted(map(id, kept)) == sorted(map(id, rows)), "both are written down", 3 * PATIENCE_S
    )
    assert "RuntimeError: anything" in caplog.text


def test_presses_at_names_that_somebody_makes_up_are_few_lines_of_the_log(
    quiet, kept, settings, tmp_path, caplog
):
    settings.DATA_DIR = tmp_path
    for second in range(5):
        quiet.now = float(second)
        for _ in range(100):
            quiet.record(halted(station="odd", pk=None))
        quiet.write_due()
        for number in range(100):
            quiet.record(halted(station=f"odd-{second}-{number}", pk=None))
        quiet.write_due()
    assert len(caplog.messages) == module._MOST_NAMES + 1, "of so many names, and one of all others"
    quiet.now = module._EVERY_S
    quiet.record(halted(station="odd", pk=None))
    quiet.write_due()
    assert caplog.messages[-1].endswith("there is no such station (400 before it)")
    assert kept == []


def test_what_came_to_nothing_gives_way_to_what_was_carried_out(quiet, kept, monkeypatch, caplog):
    monkeypatch.setattr(module, "_MOST", 3)
    rows = [halted(), *(halted(station=f"odd-{n}", status=CommandStatus.FAILED) for n in range(9))]
    for row in rows:
        quiet.record(row)
    quiet.write_due()
    assert [row.station.name for row in kept] == ["bench-1", "odd-7", "odd-8"]
    assert len(caplog.messages) == 1


def test_so_many_different_ones_wait_and_the_log_has_the_others(quiet, kept, monkeypatch, caplog):
    monkeypatch.setattr(module, "_MOST", 2)
    for name in ("ann", "bob", "cyd"):
        quiet.record(halted(user=name))
    quiet.write_due()
    assert [row.user.username for row in kept] == ["bob", "cyd"]
    assert "is given up" in caplog.text


def test_what_waits_for_its_second_is_in_the_journal_until_it_is_handed_on(kept):
    ahead = []
    quiet = Quiet(kept.append, journal=lambda rows: ahead.append(list(rows)))
    rows = [halted() for _ in range(4)]
    for row in rows[:3]:
        quiet.record(row)
        quiet.write_due()
    assert (kept, ahead[-2:]) == ([rows[0]], [[rows[1]], [rows[2]]])
    quiet.now = 1.0
    quiet.record(rows[3])
    quiet.write_due()
    assert (kept, ahead[-2:]) == ([rows[0], rows[3]], [[], []])


def test_a_journal_that_the_disk_does_not_take_keeps_nothing_from_being_written(kept, caplog):
    def full(rows):
        raise OSError("no space left on device")

    quiet = Quiet(kept.append, journal=full)
    for _ in range(2):
        quiet.record(halted())
        quiet.write_due()
    quiet.write_due(all_of_them=True)
    assert len(kept) == 2
    assert "a kill would lose 1 stops" in caplog.text
