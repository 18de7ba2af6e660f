import json
import socket
from types import SimpleNamespace

import pytest
from django.core.management import CommandError, call_command

from evaweb.core.errors import StationGone
from evaweb.lab import machine_check
from evaweb.lab.machine_check import Line, State
from evaweb.stations.models import Station


@pytest.fixture
def said(monkeypatch):
    """What programs of the machine say, by their names; others are not there."""
    words = {}
    monkeypatch.setattr(
        machine_check, "_output", lambda arguments: words.get(arguments[0].rpartition("/")[2])
    )
    return words


@pytest.mark.parametrize(
    ("words", "state", "found"),
    [
        ({}, State.UNKNOWN, "neither chrony nor systemd"),
        ({"timedatectl": "yes\n"}, State.GOOD, "systemd: synchronised"),
        ({"timedatectl": "no\n"}, State.LACKING, "systemd: not synchronised"),
        (
            {"chronyc": "Leap status     : Normal\nSystem time     : 0.000012 seconds slow of NTP time\n"},
            State.GOOD,
            "0.000012 seconds slow",
        ),
        (
            {"chronyc": "Leap status     : Not synchronised\n", "timedatectl": "yes"},
            State.LACKING,
            "not synchronised",
        ),
    ],
)
def test_the_clock_is_what_chrony_or_systemd_says(said, words, state, found):
    said.update(words)
    line = machine_check.clock()
    assert line.state is state
    assert found in line.found
    assert (line.advice == "") is (state is State.GOOD)


def test_a_gpu_is_told_as_it_is_and_none_is_no_fault(said):
    assert (machine_check.gpu().found, machine_check.gpu().advice) == ("none seen", "")
    said["nvidia-smi"] = "NVIDIA H100, 12 MiB, 81559 MiB\n"
    assert machine_check.gpu().found == "NVIDIA H100, 12 MiB, 81559 MiB"


@pytest.mark.parametrize(
    ("got", "advice", "state"),
    [
        ("FIFO 20", "", State.GOOD),
        ("FIFO 20 unlocked", "", State.LACKING),
        ("slice 0.1 ms", "give the station's user an rtprio limit", State.LACKING),
    ],
)
def test_real_time_rights_are_what_a_process_of_its_own_got(said, monkeypatch, got, advice, state):
    monkeypatch.setattr(machine_check.sys, "executable", "/x/python")
    said["python"] = json.dumps([got, advice])
    line = machine_check.realtime()
    assert (line.state, line.found) == (state, got)
    assert advice in line.advice
    assert ("memlock" in line.advice) is ("unlocked" in got)


def test_a_process_really_asks(settings):
    assert machine_check.realtime().state is not State.UNKNOWN


def test_the_disks_speed_leaves_nothing_behind_and_a_disk_that_refuses_is_bad(settings, tmp_path):
    settings.DATA_DIR = tmp_path
    assert "MB/s" in machine_check.disk_speed().found
    assert list(tmp_path.iterdir()) == []
    settings.DATA_DIR = tmp_path / "gone"
    assert machine_check.disk_speed().state is State.BAD


def test_room_is_bad_lacking_or_good(monkeypatch, tmp_path):
    def free(gigabytes):
        monkeypatch.setattr(
            machine_check.shutil, "disk_usage", lambda folder: _Usage(100e9, 0, gigabytes * 1e9)
        )
        return machine_check._room("Disk", tmp_path, 2, 50, "why", "make room")

    assert [free(size).state for size in (1, 10, 60)] == [State.BAD, State.LACKING, State.GOOD]
    assert free(1).advice == "make room"


class _Usage:
    def __init__(self, total, used, free):
        self.total, self.used, self.free = total, used, free


def test_a_port_that_another_program_has_is_named(settings, tmp_path, monkeypatch):
    settings.DATA_DIR = tmp_path
    with socket.socket() as other, socket.socket() as free:
        other.bind(("127.0.0.1", 0))
        other.listen()
        free.bind(("127.0.0.1", 0))  # and does not listen
        taken, unused = (one.getsockname()[1] for one in (other, free))
        monkeypatch.setattr(machine_check, "_PORTS", (taken, taken))
        line = machine_check.ports()
    assert line.state is State.LACKING
    assert line.found.startswith(f"{taken} and {taken} taken")
    monkeypatch.setattr(machine_check, "_PORTS", (unused,))
    assert machine_check.ports().state is State.GOOD


@pytest.mark.django_db
def test_a_station_that_runs_says_what_it_got_and_one_that_does_not_says_nothing(monkeypatch):
    for name in ("bench-1", "bench-2"):
        Station.objects.create(name=name, robot="ur5e")
    got = {"bench-1": {"control": {"scheduling": "ordinary unlocked"}, "link": {"scheduling": "ordinary"}}}

    def wire_to(name):
        if name not in got:
            raise StationGone(name)
        return SimpleNamespace(status=lambda timeout: got[name])

    monkeypatch.setattr(machine_check, "connection_to", wire_to)
    (line,) = machine_check.stations()
    assert (line.name, line.state) == ("Station bench-1", State.LACKING)
    assert line.found == "control ordinary unlocked, reception ordinary"
    got["bench-1"] = {"control": {"scheduling": "FIFO 20"}, "link": {"scheduling": "FIFO 19"}}
    assert machine_check.stations()[0].state is State.GOOD


def test_the_command_prints_each_line_and_fails_where_something_will_not_work(monkeypatch, capsys):
    rows = [Line("Cores", State.GOOD, "8 cores", "why"), Line("Memory", State.BAD, "none", "why", "buy some")]
    monkeypatch.setattr(machine_check, "lines", lambda: rows)
    with pytest.raises(CommandError, match="this will not work: Memory"):
        call_command("check_machine")
    assert "To do: buy some" in capsys.readouterr().out
    monkeypatch.setattr(machine_check, "lines", lambda: rows[:1])
    call_command("check_machine", json=True)
    assert json.loads(capsys.readouterr().out)[0]["state"] == "good"


@pytest.mark.django_db
def test_the_page_is_for_administrators(client, alma, ann, monkeypatch):
    monkeypatch.setattr(machine_check, "lines", lambda: [Line("Cores", State.GOOD, "8 cores", "why")])
    client.force_login(ann)
    assert client.get("/setup/machine/").status_code == 403
    client.force_login(alma)
    assert "8 cores" in client.get("/setup/machine/").content.decode()
