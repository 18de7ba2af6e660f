"""Stops that the database did not take: written whenever it comes back, by whoever is up then."""

from __future__ import annotations

import sqlite3
from datetime import timedelta
from uuid import UUID, uuid4

import pytest
from django.db import OperationalError, connection
from django.utils import timezone

from evaweb.errors import NotFound
from evaweb.stations import commands, leases, unwritten
from evaweb.stations.models import Command, CommandStatus, Station
from evaweb.stations.unwritten import Unwritten
from runtime.recording.files import DiskFullError
from tests.processes import eventually


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    """Where they wait in this test."""
    monkeypatch.setattr(unwritten, "_folder", lambda: tmp_path / "unwritten")
    return tmp_path / "unwritten"


@pytest.fixture
def asleep(monkeypatch):
    """No thread looks: the test does."""
    monkeypatch.setattr(Unwritten, "look", lambda self: None)


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
    monkeypatch.setattr(unwritten, "_AGAIN_S", 0.01)
    monkeypatch.setattr(commands, "_NOTE_S", 0.0)
    tried = []
    written = commands._written

    def counted(row):
        tried.append(row.uuid)
        if len(tried) < 5:
            raise OperationalError("database is locked")  # its usual patience, without the seconds
        return written(row)

    monkeypatch.setattr(commands.unwritten, "_write", counted)
    runtime.ready()
    lease = leases.claim(user=ann, station=live, page="p1")
    page = {"user": ann, "station": live, "page": "p1", "epoch": lease.epoch}
    commands.issue(kind="run", **page, boot=runtime.boot, sequence=runtime.session.sequence)
    other = sqlite3.connect(connection.settings_dict["NAME"], isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    row = commands.issue(kind="halt", **page)
    assert (row.status, runtime.session.state) == (CommandStatus.ACCEPTED, "holding")
    assert not Command.objects.filter(kind="halt").exists()
    over = timezone.now()
    other.execute("ROLLBACK")
    other.close()
    eventually(
        lambda: Command.objects.filter(kind="halt").exists() and not list(folder.iterdir()),
        60,
        "the halt is written down",
    )
    found = Command.objects.get(kind="halt")
    assert (found.uuid, found.status, found.user, found.holder) == (row.uuid, row.status, ann, "web:ann:p1")
    assert found.issued_at == row.issued_at < over, "when it was pressed, not when it was written"
    assert len(tried) >= 5


@pytest.mark.usefixtures("asleep")
def test_another_process_writes_what_one_that_has_ended_left(halted, ann, folder):
    row = halted(ann)
    row.issued_at = timezone.now() - timedelta(minutes=5)
    Unwritten(away).keep(row)
    assert Unwritten(away).attempt() is True
    assert [path.name for path in folder.iterdir()] == [f"{row.uuid}.json"]
    later = Unwritten(commands._written)
    assert later.attempt() is False
    found = Command.objects.get()
    for name in ("uuid", "station", "user", "kind", "holder", "epoch", "status", "allowed", "issued_at"):
        assert getattr(found, name) == getattr(row, name)
    assert found.answered_at == row.answered_at
    assert list(folder.iterdir()) == []


@pytest.mark.usefixtures("asleep")
def test_what_two_processes_write_is_one_row(halted):
    row = halted()
    for _ in range(2):
        one = Unwritten(commands._written)
        one.keep(row)
        one.attempt()
    assert Command.objects.get().uuid == row.uuid


@pytest.mark.usefixtures("asleep")
def test_an_answer_that_came_later_is_written_into_the_row_that_has_none(halted):
    row = halted()
    Command.objects.create(
        uuid=row.uuid, station=row.station, kind="halt", status=CommandStatus.UNKNOWN, reason="no answer"
    )
    one = Unwritten(commands._written)
    one.keep(row)
    one.attempt()
    assert (Command.objects.get().status, Command.objects.get().reason) == (CommandStatus.ACCEPTED, "")


@pytest.mark.usefixtures("asleep")
def test_where_the_disk_does_not_take_them_either_the_newest_are_kept(halted, monkeypatch, caplog):
    def full(path, data):
        raise DiskFullError("disk full")

    monkeypatch.setattr(unwritten, "write_whole", full)
    monkeypatch.setattr(unwritten, "_MOST", 3)
    one, rows = Unwritten(commands._written), [halted() for _ in range(5)]
    for row in rows:
        one.keep(row)
    assert one.attempt() is False
    assert set(Command.objects.values_list("uuid", flat=True)) == {row.uuid for row in rows[2:]}
    for row in rows[:2]:
        assert f'"uuid": "{row.uuid}"' in caplog.text, "the log has those that were given up"
    assert one.attempt() is False


@pytest.mark.usefixtures("asleep")
def test_what_the_database_refuses_for_good_keeps_nothing_else_waiting(halted, folder, caplog):
    def written(row):
        if row.kind == "estop":
            raise NotFound("station 'gone' does not exist")
        rows.append(row.uuid)

    rows: list[UUID] = []
    one, refused, row = Unwritten(written), halted(), halted()
    refused.kind = "estop"
    for each in (refused, row):
        one.keep(each)
    (folder / f"{uuid4()}.json").write_text("half a fi")
    assert one.attempt() is False
    assert rows == [row.uuid]
    assert {path.suffix for path in folder.iterdir()} == {".refused"}
    assert f"{refused.uuid}.refused" in {path.name for path in folder.iterdir()}
    assert "station 'gone' does not exist" in caplog.text


@pytest.mark.usefixtures("asleep")
@pytest.mark.parametrize(
    "spoiled",
    [b"[]", b"null", b'{"uuid": 5}', b"\xff\xfe\x00", b"[" * 200_000, b'{"user": "", "issued_at": 5}'],
    ids=lambda spoiled: repr(spoiled[:12]),
)
def test_a_file_that_holds_something_else_keeps_nothing_else_waiting(halted, folder, spoiled):
    one, row = Unwritten(commands._written), halted()
    one.keep(row)
    (folder / "0.json").write_bytes(spoiled)
    assert one.attempt() is False
    assert Command.objects.get().uuid == row.uuid
    assert [path.name for path in folder.iterdir()] == ["0.refused"]


@pytest.mark.usefixtures("asleep")
def test_a_number_that_no_database_has_keeps_nothing_else_waiting(halted, folder):
    one, refused, row = Unwritten(commands._written), halted(), halted()
    refused.epoch = 1 << 70
    for each in (refused, row):
        one.keep(each)
    assert one.attempt() is False
    assert Command.objects.get().uuid == row.uuid
    assert [path.name for path in folder.iterdir()] == [f"{refused.uuid}.refused"]


@pytest.mark.usefixtures("asleep")
def test_a_file_that_the_disk_does_not_give_is_tried_again_and_the_others_are_written(
    halted, folder, monkeypatch
):
    one, rows = Unwritten(commands._written), sorted((halted() for _ in range(3)), key=lambda row: row.uuid)
    for row in rows:
        one.keep(row)
    (folder / "0.json").mkdir()
    path = unwritten._path
    with monkeypatch.context() as patch:
        patch.setattr(unwritten, "_path", lambda name: folder if name == str(rows[0].uuid) else path(name))
        assert one.attempt() is True
    assert set(Command.objects.values_list("uuid", flat=True)) == {row.uuid for row in rows[1:]}
    assert one.attempt() is False
    assert Command.objects.count() == 3
