import errno
import json
import os

import pytest

from runtime.ipc.messages import Ack, Command
from runtime.processes.coordinator import command_journal
from runtime.processes.coordinator.command_journal import CommandJournal

ACK = Ack("u-1", "accepted", "", ["stop"], "boot-1", 3, {"epoch": 2, "holder": "anna"})


@pytest.fixture
def path(tmp_path):
    return tmp_path / "commands.jsonl"


@pytest.fixture
def journal(tmp_path):
    made = CommandJournal(tmp_path)
    yield made
    made.close()


def reopened(folder):
    journal = CommandJournal(folder)
    journal.close()
    return journal.answers


def lines(path):
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()]


def test_a_new_station_has_no_answers_and_gets_a_folder(tmp_path):
    assert reopened(tmp_path / "stations" / "bench-1") == {}


def test_a_restart_remembers_every_answer(tmp_path, journal):
    refused = Ack("u-2", "refused", "not now", ["setup"])
    assert journal.append(Command("u-1", "run"), ACK) == ""
    assert journal.append(Command("u-2", "halt"), refused) == ""
    assert reopened(tmp_path) == {"u-1": ACK, "u-2": refused}


def test_answers_of_one_moment_are_on_disk_at_the_price_of_one(tmp_path, journal, monkeypatch):
    synced = []
    monkeypatch.setattr(command_journal.os, "fdatasync", synced.append)
    answered = [(Command(f"u-{n}", "run"), Ack(f"u-{n}", "refused", str(n))) for n in range(5)]
    assert journal.append_all(answered) == ""
    assert journal.append_all([]) == ""
    assert len(synced) == 1
    assert list(reopened(tmp_path).values()) == [ack for _, ack in answered]


def test_a_line_says_who_asked_for_what_under_which_lease(journal, path):
    journal.append(Command("u-1", "run", {"scene": [1]}, "anna", "page-7", 2), ACK)
    (row,) = lines(path)
    assert row["wall"] > 0
    assert {key: row[key] for key in ("uuid", "kind", "args", "user", "holder", "epoch")} == {
        "uuid": "u-1",
        "kind": "run",
        "args": {"scene": [1]},
        "user": "anna",
        "holder": "page-7",
        "epoch": 2,
    }


@pytest.mark.parametrize("torn", [1, 10, 60, -1])
def test_a_torn_last_line_is_cut_off_and_what_follows_is_whole(tmp_path, journal, path, torn):
    journal.append(Command("u-1", "run"), ACK)
    whole = path.read_bytes()
    path.write_bytes(whole + whole.replace(b"u-1", b"u-2")[:torn])
    assert reopened(tmp_path) == {"u-1": ACK}
    assert path.read_bytes() == whole
    again = CommandJournal(tmp_path)
    again.append(Command("u-3", "stop"), Ack("u-3", "accepted"))
    again.close()
    assert list(reopened(tmp_path)) == ["u-1", "u-3"]


@pytest.mark.parametrize(
    "damage", [b"\xff\xfe\n", b"5\n", b"[1]\n", b"{}\n", b'{"uuid": [], "ack": {}}\n', b"\n"]
)
def test_a_damaged_line_costs_nothing_but_itself(tmp_path, journal, path, damage):
    journal.append(Command("u-1", "run"), ACK)
    with path.open("ab") as file:
        file.write(damage)
    journal.append(Command("u-2", "stop"), Ack("u-2", "accepted"))
    assert list(reopened(tmp_path)) == ["u-1", "u-2"]


def test_of_a_long_file_only_the_end_is_read(tmp_path, journal, monkeypatch):
    for number in range(50):
        journal.append(Command(f"u-{number}", "stop"), Ack(f"u-{number}", "accepted"))
    monkeypatch.setattr(command_journal, "REMEMBERED", 10)
    assert list(reopened(tmp_path)) == [f"u-{n}" for n in range(40, 50)]
    monkeypatch.setattr(command_journal, "_TAIL_BYTES", 1000)
    assert list(reopened(tmp_path))[-1] == "u-49"
    assert len(reopened(tmp_path)) < 10


def test_what_json_does_not_know_is_written_as_text(tmp_path, journal, path):
    journal.append(Command("u-1", "run", {"path": tmp_path}), ACK)
    assert lines(path)[0]["args"] == {"path": str(tmp_path)}


def full_disk(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_disk_that_fails_is_told_and_leaves_no_half_line(tmp_path, journal, path, monkeypatch):
    journal.append(Command("u-1", "run"), ACK)
    before = path.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(os, "fdatasync", full_disk)
        doubt = journal.append(Command("u-2", "stop"), Ack("u-2", "accepted"))
    assert "No space left on device" in doubt
    assert "stop could be given twice" in doubt
    assert path.read_bytes() == before
    assert journal.append(Command("u-3", "stop"), Ack("u-3", "accepted")) == ""
    assert list(reopened(tmp_path)) == ["u-1", "u-3"]


def nested(depth):
    inner = {}
    for _ in range(depth):
        inner = {"a": inner}
    return inner


@pytest.mark.parametrize(
    "args", [{b"key": 1}, {"a": {(1, 2): 3}}, nested(100_000)], ids=["bytes", "tuple", "deep"]
)
def test_arguments_that_are_no_json_do_not_end_who_refused_them(tmp_path, journal, path, args):
    refused = Ack("u-3", "refused", "no JSON")
    assert journal.append(Command("u-3", "run", args), refused) == ""
    (row,) = lines(path)
    assert row["args"].startswith("no JSON: ")
    assert reopened(tmp_path) == {"u-3": refused}
