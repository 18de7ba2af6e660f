"""Stops that the database did not take: written whenever it comes back, by whoever is up then."""

from __future__ import annotations

import errno
import json
import os
import signal
import sqlite3
import stat
from copy import copy
from datetime import timedelta
from uuid import UUID, uuid4

import pytest
from django.db import OperationalError, connection
from django.utils import timezone

from evaweb.core.errors import Conflict, NotFound
from evaweb.stations import commands, leases, unwritten_commands
from evaweb.stations.models import Command, CommandStatus, Station
from evaweb.stations.process_journal import recover_journals
from evaweb.stations.unwritten_commands import UnwrittenCommands
from runtime.recording.files import DiskFullError
from tests.processes import PATIENCE_S, eventually


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    """Where they wait in this test."""
    monkeypatch.setattr(unwritten_commands, "_folder", lambda: tmp_path / "unwritten")
    return tmp_path / "unwritten"


@pytest.fixture
def asleep(monkeypatch):
    """No thread looks: the test does."""
    monkeypatch.setattr(UnwrittenCommands, "start_writing", lambda self: None)


@pytest.fixture
def halted(db):
    """A halt that was carried out, as it would be written; another one with each call."""
    station = Station.objects.create(name="bench-1", robot="agilex_piper")

    def made(user=None) -> Command:
        answer = {"status": CommandStatus.ACCEPTED, "allowed": ["resume"], "answered_at": timezone.now()}
        given = {"kind": "halt", "holder": "web:ann:p1", "epoch": 3}
        return Command(uuid=uuid4(), station=station, user=user, **given, **answer)

    return made


def away(row):
    raise OperationalError("database is locked")


@pytest.mark.django_db(transaction=True)
@pytest.mark.skipif(connection.vendor != "sqlite", reason="only SQLite is locked as a whole")
def test_a_halt_during_a_locked_database_is_carried_out_and_written_when_the_lock_is_over(
    live, ann, runtime, monkeypatch, folder
):
    monkeypatch.setattr(unwritten_commands, "_AGAIN_S", 0.01)
    monkeypatch.setattr(commands.notes, "record", commands.unwritten.store)
    tried = []
    written = commands._stored_row

    def counted(row):
        tried.append(row.uuid)
        if len(tried) < 5:
            raise OperationalError("database is locked")  # its usual patience, without the seconds
        return written(row)

    monkeypatch.setattr(commands.unwritten, "_write", counted)
    runtime.ready()
    lease = leases.claim(user=ann, station=live, page="p1")
    page = {"user": ann, "station": live, "page": "p1", "epoch": lease.epoch}
    commands.issue_command(kind="run", **page, boot=runtime.boot, sequence=runtime.session.sequence)
    other = sqlite3.connect(connection.settings_dict["NAME"], isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    row = commands.issue_command(kind="halt", **page)
    assert (row.status, runtime.session.state) == (CommandStatus.ACCEPTED, "holding")
    assert not Command.objects.filter(kind="halt").exists()
    over = timezone.now()
    other.execute("ROLLBACK")
    other.close()
    eventually(
        lambda: Command.objects.filter(kind="halt").exists() and not list(folder.iterdir()),
        "the halt is written down",
        3 * PATIENCE_S,
    )
    found = Command.objects.get(kind="halt")
    assert (found.uuid, found.status, found.user, found.holder) == (row.uuid, row.status, ann, "web:ann:p1")
    assert found.issued_at == row.issued_at < over, "when it was pressed, not when it was written"
    assert len(tried) >= 5


@pytest.mark.usefixtures("asleep")
def test_another_process_writes_what_one_that_has_ended_left(halted, ann, folder):
    row = halted(ann)
    row.issued_at = timezone.now() - timedelta(minutes=5)
    UnwrittenCommands(away).store(row)
    assert UnwrittenCommands(away).write_all() is True
    assert [path.name for path in folder.iterdir()] == [f"{row.uuid}.{os.getpid()}.json"]
    later = UnwrittenCommands(commands._stored_row)
    assert later.write_all() is False
    found = Command.objects.get()
    for name in ("uuid", "station", "user", "kind", "holder", "epoch", "status", "allowed", "issued_at"):
        assert getattr(found, name) == getattr(row, name)
    assert found.answered_at == row.answered_at
    assert list(folder.iterdir()) == []


@pytest.mark.usefixtures("asleep")
def test_what_two_processes_write_is_one_row(halted):
    row = halted()
    for _ in range(2):
        one = UnwrittenCommands(commands._stored_row)
        one.store(row)
        one.write_all()
    assert Command.objects.get().uuid == row.uuid


@pytest.mark.usefixtures("asleep")
def test_an_answer_that_came_later_is_written_into_the_row_that_has_none(halted):
    row = halted()
    Command.objects.create(
        uuid=row.uuid, station=row.station, kind="halt", status=CommandStatus.UNKNOWN, reason="no answer"
    )
    one = UnwrittenCommands(commands._stored_row)
    one.store(row)
    one.write_all()
    assert (Command.objects.get().status, Command.objects.get().reason) == (CommandStatus.ACCEPTED, "")


@pytest.mark.usefixtures("asleep")
def test_where_the_disk_does_not_take_them_either_the_newest_are_kept(halted, monkeypatch, caplog):
    def full(path, data):
        raise DiskFullError("disk full")

    monkeypatch.setattr(unwritten_commands, "write_atomic", full)
    monkeypatch.setattr(unwritten_commands, "_MOST", 3)
    one, rows = UnwrittenCommands(commands._stored_row), [halted() for _ in range(5)]
    for row in rows:
        one.store(row)
    assert one.write_all() is False
    assert set(Command.objects.values_list("uuid", flat=True)) == {row.uuid for row in rows[2:]}
    for row in rows[:2]:
        assert f'"uuid": "{row.uuid}"' in caplog.text, "the log has those that were given up"
    assert one.write_all() is False


@pytest.mark.usefixtures("asleep")
def test_what_the_database_refuses_for_good_keeps_nothing_else_waiting(halted, folder, caplog):
    def written(row):
        if row.kind == "estop":
            raise NotFound("station 'gone' does not exist")
        rows.append(row.uuid)

    rows: list[UUID] = []
    one, refused, row = UnwrittenCommands(written), halted(), halted()
    refused.kind = "estop"
    for each in (refused, row):
        one.store(each)
    (folder / f"{uuid4()}.json").write_text("half a fi")
    assert one.write_all() is False
    assert rows == [row.uuid]
    assert {path.suffix for path in folder.iterdir()} == {".refused"}
    assert f"{refused.uuid}.{os.getpid()}.refused" in {path.name for path in folder.iterdir()}
    assert "station 'gone' does not exist" in caplog.text


@pytest.mark.usefixtures("asleep")
@pytest.mark.parametrize(
    "spoiled",
    [b"[]", b"null", b'{"uuid": 5}', b"\xff\xfe\x00", b"[" * 200_000, b'{"user": "", "issued_at": 5}'],
    ids=lambda spoiled: repr(spoiled[:12]),
)
def test_a_file_that_holds_something_else_keeps_nothing_else_waiting(halted, folder, spoiled):
    one, row = UnwrittenCommands(commands._stored_row), halted()
    one.store(row)
    (folder / "0.json").write_bytes(spoiled)
    assert one.write_all() is False
    assert Command.objects.get().uuid == row.uuid
    assert [path.name for path in folder.iterdir()] == ["0.refused"]


@pytest.mark.usefixtures("asleep")
def test_a_number_that_no_database_has_keeps_nothing_else_waiting(halted, folder):
    one, refused, row = UnwrittenCommands(commands._stored_row), halted(), halted()
    refused.epoch = 1 << 70
    for each in (refused, row):
        one.store(each)
    assert one.write_all() is False
    assert Command.objects.get().uuid == row.uuid
    assert [path.name for path in folder.iterdir()] == [f"{refused.uuid}.{os.getpid()}.refused"]


@pytest.mark.usefixtures("asleep")
def test_a_file_that_the_disk_does_not_give_is_tried_again_and_the_others_are_written(
    halted, folder, monkeypatch
):
    one, rows = (
        UnwrittenCommands(commands._stored_row),
        sorted((halted() for _ in range(3)), key=lambda row: row.uuid),
    )
    for row in rows:
        one.store(row)
    (folder / "0.json").mkdir()
    path = unwritten_commands._path
    with monkeypatch.context() as patch:
        patch.setattr(
            unwritten_commands,
            "_path",
            lambda name: folder if name.startswith(str(rows[0].uuid)) else path(name),
        )
        assert one.write_all() is True
    assert set(Command.objects.values_list("uuid", flat=True)) == {row.uuid for row in rows[1:]}
    assert one.write_all() is False
    assert Command.objects.count() == 3


@pytest.fixture
def pressed(halted, ann, bob):
    """One press as a process heard of it."""
    uuid, station = uuid4(), halted().station

    def heard(status=CommandStatus.DONE, user=ann, kind="estop", **given):
        return Command(uuid=uuid, station=station, user=user, kind=kind, status=status, **given)

    return heard


@pytest.mark.usefixtures("asleep")
def test_two_processes_that_carried_out_one_press_have_a_file_each_and_it_is_one_row(
    pressed, folder, monkeypatch
):
    web, stops = UnwrittenCommands(commands._stored_row), UnwrittenCommands(commands._stored_row)
    web.store(pressed(CommandStatus.FAILED, reason="the station is gone"))
    monkeypatch.setattr(os, "getpid", lambda: 1)
    stops.store(pressed())
    assert len(list(folder.iterdir())) == 2
    assert [one.write_all() for one in (web, stops)] == [False, False]
    assert list(folder.iterdir()) == []
    assert (Command.objects.get().status, Command.objects.get().reason) == ("done", "")


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_whichever_way_is_written_first_the_row_has_what_was_done_and_by_whom(pressed, ann, order):
    ways = [pressed(), pressed(CommandStatus.UNKNOWN, None, args={"unverified": "the database hung"})]
    for number in order:
        commands._stored_row(ways[number])
    row = Command.objects.get()
    assert (row.status, row.user, row.args) == ("done", ann, {})


def latched(at, how="anew"):
    return {"latched": how, "carried_out_at": at}


def test_a_press_that_latched_anew_with_the_uuid_of_an_earlier_one_has_a_row_of_its_own(pressed, ann):
    first, again = pressed(data=latched(10.0)), pressed(data=latched(20.0))
    for row in (first, again, again, first):  # each may be tried more than once
        commands._stored_row(copy(row))
    kept, late = Command.objects.order_by("answered_at", "issued_at")
    assert (kept.uuid, kept.data) == (first.uuid, latched(10.0))
    assert late.uuid != first.uuid
    assert (late.user, late.status, late.issued_at) == (ann, "done", again.issued_at)
    assert late.data["carried_out_at"] == 20.0
    assert late.data["sent_uuid"] == str(first.uuid)
    assert late.data["repeat"] == "pressed again, or a late copy: this uuid was carried out before"


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0)])
def test_the_answer_to_an_earlier_press_is_no_row_more_and_hides_not_that_it_latched(pressed, order):
    ways = [
        pressed(data=latched(10.0)),
        pressed(data=latched(10.0, "before")),
        pressed(CommandStatus.UNKNOWN, None),
    ]
    for number in order:
        commands._stored_row(ways[number])
    assert Command.objects.get().data == latched(10.0)


@pytest.mark.parametrize("how", ["anew", "already", "before"])
def test_a_press_with_the_uuid_of_another_persons_has_a_row_of_its_own(pressed, ann, bob, how):
    commands._stored_row(pressed(data=latched(10.0)))
    for _ in range(2):  # both ways
        commands._stored_row(pressed(user=bob, data=latched(10.0 if how == "before" else 11.0, how)))
    rows = {row.user: row for row in Command.objects.all()}
    assert len(rows) == Command.objects.count() == 2
    assert rows[bob].data["sent_uuid"] == str(rows[ann].uuid)
    assert rows[bob].data["latched"] == how
    assert "another command" in rows[bob].data["repeat"]


@pytest.mark.parametrize("user", ["ann", None])
def test_a_press_with_the_uuid_of_a_run_has_a_row_of_its_own(pressed, ann, user):
    run = pressed(kind="run")
    run.save(force_insert=True)
    commands._stored_row(pressed(user=ann if user else None, data=latched(10.0)))
    row = Command.objects.get(kind="estop")
    assert (row.user, row.data["sent_uuid"]) == (ann if user else None, str(run.uuid))


def test_a_uuid_is_still_no_other_commands(pressed):
    commands._stored_row(pressed())
    with pytest.raises(Conflict):
        commands._stored_row(pressed(kind="halt"))


def in_a_process_that_is_killed(work):
    """Do it in a copy of this process, which ends without another line."""
    child = os.fork()
    if child == 0:
        try:
            work()
        finally:
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)


@pytest.mark.usefixtures("asleep")
def test_what_a_killed_process_had_foreseen_is_kept_by_whoever_looks_next_as_one_row_with_how_many(
    halted, ann, folder
):
    rows = [halted(ann) for _ in range(3)]
    stop = halted(ann)
    stop.kind = "stop"
    in_a_process_that_is_killed(lambda: UnwrittenCommands(away).prepare([*rows, stop]))
    assert len(list(folder.iterdir())) == 1
    assert UnwrittenCommands(commands._stored_row).write_all() is False
    assert {(row.uuid, row.kind): row.data for row in Command.objects.all()} == {
        (rows[-1].uuid, "halt"): {"times": 3},
        (stop.uuid, "stop"): {},
    }
    assert list(folder.iterdir()) == []


@pytest.mark.usefixtures("asleep")
def test_what_a_living_process_foresees_is_left_to_it(halted, folder):
    one, other = UnwrittenCommands(commands._stored_row), UnwrittenCommands(commands._stored_row)
    one.prepare([halted()])
    one.prepare([halted()])
    assert len(list(folder.iterdir())) == 1
    assert other.write_all() is False
    assert not Command.objects.exists()
    one.prepare([])
    assert list(folder.iterdir()) == []
    one.prepare([halted()])
    assert len(list(folder.iterdir())) == 1


@pytest.mark.usefixtures("asleep")
def test_half_a_line_of_a_killed_process_keeps_no_other_from_being_written(halted, ann, folder, caplog):
    row = halted(ann)
    in_a_process_that_is_killed(lambda: UnwrittenCommands(away).prepare([row]))
    (left,) = folder.iterdir()
    with left.open("ab") as file:
        file.write(b'[]\n{"uuid": "0b')
    UnwrittenCommands(commands._stored_row).write_all()
    assert [found.uuid for found in Command.objects.all()] == [row.uuid]
    assert caplog.text.count("a command is not in the database") == 2
    assert [path.name for path in folder.iterdir()] == [f"{left.stem}.refused"]


@pytest.mark.usefixtures("asleep")
@pytest.mark.parametrize(
    "odd",
    [b"[" * 200_000, b"\xff", {"uuid": 5}, {"kind": ["halt"]}, {"data": 5}, {"station": {}}],
    ids=lambda odd: repr(odd[:12] if isinstance(odd, bytes) else odd),
)
def test_an_odd_line_keeps_no_other_from_being_written(halted, ann, folder, caplog, odd):
    first, last, other = (halted(ann) for _ in range(3))
    last.kind = "stop"
    in_a_process_that_is_killed(lambda: UnwrittenCommands(away).prepare([other]))
    good = [json.dumps(unwritten_commands._document(row)).encode() for row in (first, last)]
    if isinstance(odd, dict):
        odd = json.dumps(unwritten_commands._document(halted(ann)) | odd).encode()
    lines = [good[0], odd, good[1], b""]
    (folder / "0.lines").write_bytes(b"\n".join(lines))
    for _ in range(2):
        assert UnwrittenCommands(commands._stored_row).write_all() is False
    assert {row.uuid for row in Command.objects.all()} == {first.uuid, last.uuid, other.uuid}
    assert caplog.text.count("a command is not in the database") == 1
    assert [path.name for path in folder.iterdir()] == ["0.refused"]


@pytest.mark.usefixtures("asleep")
@pytest.mark.parametrize("odd", ["fifo", "directory", "link", "socket", "forbidden"])
def test_what_is_no_file_of_ours_is_put_aside_once_and_the_others_are_written(
    halted, ann, folder, caplog, monkeypatch, tmp_path, odd
):
    row, path = halted(ann), folder / "0.lines"
    in_a_process_that_is_killed(lambda: UnwrittenCommands(away).prepare([row]))
    if odd == "fifo":
        os.mkfifo(path)
    elif odd == "directory":
        path.mkdir()
    elif odd == "link":
        path.symlink_to(tmp_path / "elsewhere")
    elif odd == "socket":
        os.mknod(path, stat.S_IFSOCK | 0o600)
    else:
        path.touch()
        forbidden(monkeypatch, path)
    for _ in range(2):
        assert UnwrittenCommands(commands._stored_row).write_all() is False
    assert Command.objects.get().uuid == row.uuid
    assert [path.name for path in folder.iterdir()] == ["0.refused"]
    assert caplog.text.count("is put aside") == 1


def forbidden(monkeypatch, path, error=errno.EACCES):
    """Have the system refuse that file."""
    opened = os.open

    def refused(name, *flags, **more):
        if name == path:
            raise OSError(error, os.strerror(error), str(name))
        return opened(name, *flags, **more)

    monkeypatch.setattr(os, "open", refused)


@pytest.mark.usefixtures("asleep")
def test_a_file_of_a_killed_process_that_the_disk_does_not_give_is_tried_again(
    halted, ann, folder, monkeypatch
):
    rows = [halted(ann) for _ in range(2)]
    for row in rows:
        in_a_process_that_is_killed(lambda row=row: UnwrittenCommands(away).prepare([row]))
    first, _ = sorted(folder.iterdir())
    with monkeypatch.context() as patch:
        forbidden(patch, first, errno.EIO)
        assert UnwrittenCommands(commands._stored_row).write_all() is True
    assert Command.objects.count() == 1
    assert UnwrittenCommands(commands._stored_row).write_all() is False
    assert {row.uuid for row in Command.objects.all()} == {row.uuid for row in rows}


def test_a_file_that_nobody_can_take_is_put_aside_and_the_next_one_is_taken(tmp_path):
    def take(lines):
        if lines == [b"0"]:
            raise RecursionError("so deep")
        taken.append(lines)
        return True

    taken = []
    for name in "01":
        (tmp_path / f"{name}.lines").write_text(f"{name}\n")
    assert recover_journals(tmp_path, take) is False
    assert taken == [[b"1"]]
    assert [path.name for path in tmp_path.iterdir()] == ["0.refused"]


def test_the_thread_survives_whatever_happens_in_one_turn(monkeypatch, caplog):
    monkeypatch.setattr(unwritten_commands, "_AGAIN_S", 0.01)
    turns = []

    def attempt():
        turns.append(1)
        if len(turns) < 3:
            raise RuntimeError("anything")
        return False

    one = UnwrittenCommands(away)
    one.write_all = attempt
    one.start_writing()
    eventually(lambda: len(turns) == 3, "it goes on", 3 * PATIENCE_S)
    assert caplog.text.count("RuntimeError: anything") == 1, "one line for many"
