import os
import signal
import socket
import sys
from pathlib import Path

import pytest

from evaweb.lab import programs
from evaweb.lab.processes import ChildProcesses, LabError, ProgramSpec, processor_s
from evaweb.serving.listeners import PortInUseError, open_listener
from tests.processes import PATIENCE_S, alive, eventually

ANSWERS = """
import socket, sys
listener = socket.socket(fileno=int(sys.argv[1]))
listener.setblocking(True)
print("{}", flush=True)
while True:
    listener.accept()[0].sendall(b"here")
"""
WAITS = "import sys\nsys.stdin.read()\n"
SAYS = 'import sys\nprint(\'{"url": "here %s"}\' % sys.argv[1], flush=True)\nsys.stdin.read()\n'
STUBBORN = "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\ntime.sleep(600)\n"


@pytest.fixture
def processes(tmp_path):
    made = ChildProcesses(tmp_path, tmp_path / "logs", os.environ)
    yield made
    made.end()


def test_a_program_that_announces_is_ready_when_it_says_where_it_is(processes):
    found = processes.start(ProgramSpec("one", ("-c", SAYS, "first"), announces=True))
    assert found == {"url": "here first"}


def test_what_dies_is_started_again_where_it_was(processes):
    again = ProgramSpec(
        "one", ("-c", SAYS, "first"), announces=True, again=lambda found: ("-c", SAYS, found["url"])
    )
    processes.start(again)
    before = processes.pids()["one"]
    os.kill(before, signal.SIGKILL)
    eventually(lambda: not alive(before), "its end")
    processes.watch()
    assert processes.pids()["one"] != before
    written = processes._logs / "one.log"
    eventually(lambda: "here here first" in written.read_text(), "it announces itself again")


def test_a_port_of_ours_is_never_free_and_who_calls_is_answered_by_the_next_process(processes):
    with open_listener("127.0.0.1", 0) as listener:
        descriptor, address = listener.fileno(), listener.getsockname()
        arguments = ("-c", ANSWERS, str(descriptor))
        processes.start(
            ProgramSpec("one", arguments, announces=True, patience_s=0.1, descriptors=(descriptor,))
        )
        before = processes.pids()["one"]
        os.kill(before, signal.SIGKILL)
        eventually(lambda: not alive(before), "its end")
        with pytest.raises(PortInUseError, match="cannot listen"):
            open_listener(*address)
        with socket.create_connection(address, PATIENCE_S) as caller:
            processes.watch()
            assert caller.recv(4) == b"here"


def test_what_dies_too_often_rests_and_takes_nobody_with_it(processes, caplog):
    processes.start(ProgramSpec("one", ("-c", "raise SystemExit('the disk is on fire')")))
    processes.start(ProgramSpec("two", ("-c", WAITS)))
    two = processes.pids()["two"]

    def rests():
        processes.watch()
        return (
            "one ended with 1, 6 times within a minute: next try in 30 s; the disk is on fire" in caplog.text
        )

    eventually(rests, "it rests")
    one = processes.pids()["one"]
    processes.watch()
    assert processes.pids() == {"one": one, "two": two}
    processes._children["one"].rests_until = 0.0
    processes.watch()
    assert processes.pids()["one"] != one
    assert processes.pids()["two"] == two


def test_a_program_that_does_not_start_is_named_with_what_it_said(processes):
    with pytest.raises(LabError, match="one did not start: no such robot"):
        processes.start(ProgramSpec("one", ("-c", "raise SystemExit('no such robot')"), announces=True))


def test_a_program_that_says_nothing_is_given_up(processes):
    with pytest.raises(LabError, match=r"one does not get ready \(.* s of the processor, nothing for"):
        processes.start(ProgramSpec("one", ("-c", WAITS), announces=True), ready_s=0.5)


def test_one_that_is_getting_ready_is_looked_at_while_others_are_watched(processes):
    begun = processes.starting(
        ProgramSpec("slow", ("-c", f"import time; time.sleep(0.3)\n{SAYS}", "there"), announces=True)
    )
    next(begun)
    processes.start(ProgramSpec("one", ("-c", WAITS)))
    before = processes.pids()
    os.kill(before["one"], signal.SIGKILL)
    eventually(lambda: not alive(before["one"]), "its end")
    processes.watch()
    assert processes.pids()["one"] != before["one"]

    def ready():
        try:
            next(begun)
        except StopIteration as done:
            return done.value

    assert eventually(ready, "it announces itself") == {"url": "here there"}
    assert processes.pids()["slow"] == before["slow"]


def test_one_that_does_not_get_ready_is_ended_and_may_be_started_anew(processes):
    with pytest.raises(LabError, match="one did not start: no such robot"):
        processes.start(ProgramSpec("one", ("-c", "raise SystemExit('no such robot')"), announces=True))
    assert processes.pids() == {}
    assert processes.start(ProgramSpec("one", ("-c", SAYS, "again"), announces=True)) == {"url": "here again"}
    with pytest.raises(LabError, match="one is a program of this lab already"):
        processes.start(ProgramSpec("one", ("-c", WAITS)))


def test_a_slow_one_is_waited_for_as_long_as_it_works(processes, monkeypatch):
    spent = iter(range(1, 40))
    monkeypatch.setattr("evaweb.lab.processes.processor_s", lambda pid: float(next(spent)))
    slow = "import time; time.sleep(1); " + SAYS.replace("import sys\n", "import sys; ", 1)
    told = processes.start(ProgramSpec("slow", ("-c", slow), announces=True), ready_s=0.0)
    assert told["url"].startswith("here")


@pytest.mark.exhaustive
def test_one_that_only_works_is_given_up(processes, monkeypatch):
    monkeypatch.setattr("evaweb.lab.processes._MOST_PROCESSOR_S", 0.2)
    with pytest.raises(LabError, match="busy does not get ready"):
        processes.start(ProgramSpec("busy", ("-c", "while True: pass"), announces=True))


def test_the_time_on_the_processor_is_that_of_the_process():
    before = processor_s(os.getpid())
    while processor_s(os.getpid()) == before:
        sum(range(100_000))
    assert processor_s(2**22 + 1) == 0.0


def test_all_end_with_their_lifelines_and_the_stubborn_are_killed(processes):
    processes.start(ProgramSpec("one", ("-c", WAITS)))
    processes.start(ProgramSpec("two", ("-c", STUBBORN), patience_s=0.2))
    pids = processes.pids().values()
    processes.end()
    assert not any(alive(pid) for pid in pids)
    assert processes.pids() == {}


def test_one_that_is_dropped_holds_up_nobody_and_is_killed_when_its_time_is_over(processes, caplog):
    processes.start(ProgramSpec("one", ("-c", STUBBORN), patience_s=0.2))
    one = processes.pids()["one"]
    processes.drop("one")
    assert processes.pids() == {}
    assert processes.ending() == {"one"}

    def ended():
        processes.watch()
        return not processes.ending()

    eventually(ended, "its end")
    assert not alive(one)
    assert caplog.text.count("one does not end by itself: killed") == 1


def test_one_that_is_dropped_has_ended_when_all_end(processes):
    processes.start(ProgramSpec("one", ("-c", WAITS)))
    one = processes.pids()["one"]
    processes.drop("one")
    processes.end()
    assert not alive(one)


@pytest.mark.slow
def test_they_end_with_us_even_when_we_are_killed(tmp_path):
    script = (
        "import os, sys, time\nfrom pathlib import Path\nfrom evaweb.lab.processes import ChildProcesses, ProgramSpec\n"
        f"p = ChildProcesses(Path({str(tmp_path)!r}), Path({str(tmp_path)!r}), os.environ)\n"
        f"p.start(ProgramSpec('one', ('-c', {WAITS!r})))\n"
        f"Path({str(tmp_path / 'pid')!r}).write_text(str(p.pids()['one']))\ntime.sleep(600)\n"
    )
    import subprocess

    parent = subprocess.Popen([sys.executable, "-c", script], cwd=Path(__file__).parents[3])
    written = tmp_path / "pid"
    eventually(lambda: written.exists() and written.read_text(), "the pid of the child")
    parent.kill()
    parent.wait()
    eventually(lambda: not alive(int(written.read_text())), "the end of the child")
    assert parent.returncode == -signal.SIGKILL


_OF_WEB = (programs.web("h", 1), programs.worker(), programs.stops(2, "1"))


def test_the_process_for_stops_has_a_socket_of_the_labs_and_gives_way_to_nobody():
    stops = programs.stops(7, "8000")
    assert (stops.announces, stops.nice, stops.descriptors) == (True, 0, (7,))
    assert stops.arguments[1:] == ("stops", "--descriptor", "7", "--web-port", "8000")


def test_the_webs_secrets_reach_the_web_and_nobody_else(tmp_path):
    says = "import json, os, sys\nprint(json.dumps(dict(os.environ)), flush=True)\nsys.stdin.read()\n"
    secrets = {"EVA_SECRET_KEY": "canary", "HF_TOKEN": "canary"}
    made = ChildProcesses(tmp_path, tmp_path / "logs", os.environ | secrets)
    try:
        web = made.start(ProgramSpec("web", ("-c", says), announces=True, of_web=True))
        station = made.start(ProgramSpec("station", ("-c", says), announces=True))
        assert {name: web[name] for name in secrets} == secrets
        assert not secrets.keys() & station.keys()
        assert "canary" not in Path(f"/proc/{made.pids()['station']}/environ").read_text()
        assert [p.of_web for p in _OF_WEB] == [True] * len(_OF_WEB)
        assert not programs.station("d.toml", ()).of_web
    finally:
        made.end()
