"""One ssh: a program that does what the test says in its place."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from runtime.policies.tunnel import ssh_process
from runtime.policies.tunnel.ssh_process import Ssh, free_port, is_listening
from tests.processes import PATIENCE_S, alive, eventually

Begin = Callable[[str], Ssh]
LISTEN = """
import socket, sys, time
near = socket.create_server(("127.0.0.1", {port}))
print("ready", file=sys.stderr, flush=True)
time.sleep(60)
"""


@pytest.fixture
def begin() -> Iterator[Begin]:
    """Starts a program as ssh, with {port} for its near end; ends it with the test."""
    running: list[Ssh] = []

    def start(code: str) -> Ssh:
        port = free_port()
        running.append(Ssh([sys.executable, "-c", code.replace("{port}", str(port))], port))
        return running[-1]

    yield start
    for ssh in running:
        ssh.terminate()


def ended(ssh: Ssh) -> int:
    eventually(lambda: ssh.poll() is not None, "its end")
    code = ssh.poll()
    assert code is not None
    return code


def test_it_listens_when_its_own_process_does(begin: Begin) -> None:
    ssh = begin(LISTEN)
    eventually(ssh.is_listening, "its near end")
    assert ssh.poll() is None


ECHO = """
import socket, sys, time
near = socket.create_server(("127.0.0.1", {port}))
print("a greeting", flush=True)
print("listening", file=sys.stderr, flush=True)
word = sys.stdin.readline()
time.sleep(0.3)
print(word, end="", flush=True)
print("ended" if not sys.stdin.readline() else "told more", file=sys.stderr, flush=True)
"""


def test_where_a_session_is_wanted_it_counts_only_once_the_far_end_has_said_the_word_again() -> None:
    port = free_port()
    ssh = Ssh([sys.executable, "-c", ECHO.replace("{port}", str(port))], port, echoes=True)
    eventually(lambda: ssh.poll() is None and "listening" in ssh.said, "its near end")
    assert is_listening(ssh.pid, port)
    assert not ssh.is_listening()
    eventually(lambda: ssh.poll() is None and ssh.is_listening(), "the far end's word")
    assert sorted(ssh.said) == ["a greeting", "listening"]  # a nologin's sentence, too, is on the output
    ssh.terminate()


def test_a_session_ends_with_its_input() -> None:
    ssh = Ssh([sys.executable, "-c", ECHO.replace("{port}", "0")], 1, echoes=True)
    eventually(lambda: ssh.poll() is None and "listening" in ssh.said, "its near end")
    assert ssh._process.stdin is not None
    ssh._process.stdin.close()
    assert ended(ssh) == 0
    assert ssh.said[-1] == "ended"
    ssh.terminate()


def test_somebody_else_on_its_port_is_not_taken_for_it(begin: Begin) -> None:
    ssh = begin("import time; print('x', file=__import__('sys').stderr, flush=True); time.sleep(60)")
    with socket.create_server(("127.0.0.1", ssh.port)):
        assert is_listening(os.getpid(), ssh.port)
        eventually(lambda: ssh.poll() is None and bool(ssh.said), "its first word")
        assert not ssh.is_listening()


def test_a_socket_that_is_bound_to_another_address_or_does_not_listen_is_none() -> None:
    with socket.socket() as bound, socket.create_server(("0.0.0.0", 0)) as everywhere:
        bound.bind(("127.0.0.1", 0))
        assert not is_listening(os.getpid(), bound.getsockname()[1])
        assert not is_listening(os.getpid(), everywhere.getsockname()[1])
    assert not is_listening(2**22 + 1, 80)


def test_what_it_says_is_kept_line_by_line_and_what_the_far_end_refuses_apart(begin: Begin) -> None:
    said = "a banner\\n\\nchannel 2: open failed: connect failed: Connection refused\\n\\x1b[31mred\\nwithout an end"
    ssh = begin(f"import sys; sys.stderr.write('{said}'); sys.exit(255)")
    assert ended(ssh) == 255
    assert list(ssh.said) == ["a banner", "[31mred", "without an end"]
    assert (ssh.refusals, ssh.refusal) == (1, "connect failed: Connection refused")


def test_however_much_it_says_little_is_kept(begin: Begin) -> None:
    ssh = begin("import sys; [sys.stderr.write('x' * 4000 + '\\n') for _ in range(500)]")
    ended(ssh)
    assert len(ssh.said) == 20
    assert {len(line) for line in ssh.said} == {300}


def test_bytes_that_are_no_text_do_no_harm(begin: Begin) -> None:
    ssh = begin("import sys; sys.stderr.buffer.write(bytes(range(256)) * 4)")
    ended(ssh)
    assert ssh.said
    assert all(line.isprintable() for line in ssh.said)


def test_it_has_no_terminal_to_ask_anybody_at(begin: Begin) -> None:
    ssh = begin(
        "import os, sys\n"
        "try: os.open('/dev/tty', os.O_RDWR)\n"
        "except OSError as error: print(type(error).__name__, os.environ['SSH_ASKPASS_REQUIRE'], file=sys.stderr)"
    )
    ended(ssh)
    assert list(ssh.said) == ["OSError never"]


def test_its_end_is_that_of_what_it_started(begin: Begin) -> None:
    ssh = begin(
        "import subprocess, sys, time\n"
        "jump = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "print(jump.pid, file=sys.stderr, flush=True); time.sleep(60)"
    )
    eventually(lambda: ssh.poll() is None and bool(ssh.said), "its first word")
    started = int(ssh.said[-1])
    assert alive(started)
    ssh.terminate()
    eventually(lambda: not alive(started), "its end")
    assert not alive(ssh.pid)


def test_one_that_does_not_want_to_end_is_made_to(begin: Begin, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ssh_process, "_PATIENCE_S", 0.2)
    ssh = begin(
        "import signal, sys, time\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN); print('deaf', file=sys.stderr, flush=True); time.sleep(60)"
    )
    eventually(lambda: ssh.poll() is None and bool(ssh.said), "its first word")
    ssh.terminate()
    assert not alive(ssh.pid)
    ssh.terminate()  # safe to call twice


def test_a_program_that_is_not_there_ends_with_a_sentence() -> None:
    ssh = Ssh(["/nowhere/ssh"], 1)
    assert ended(ssh) == 1
    assert list(ssh.said) == ["/nowhere/ssh cannot be started: No such file or directory"]
    ssh.terminate()


def test_it_ends_with_the_thread_that_started_it() -> None:
    made: list[Ssh] = []
    go_on = threading.Event()

    def start() -> None:
        made.append(Ssh([sys.executable, "-c", LISTEN.replace("{port}", str(free_port()))], 1))
        eventually(lambda: made[0].poll() is None and bool(made[0].said), "its first word")
        go_on.wait(PATIENCE_S)

    thread = threading.Thread(target=start)
    thread.start()
    eventually(lambda: bool(made and made[0].said), "its first word")
    assert alive(made[0].pid)
    go_on.set()
    thread.join()
    eventually(lambda: made[0].poll() == -signal.SIGTERM, "its end")
    made[0].terminate()


STATION = """
import sys, time
from runtime.policies.tunnel.ssh_process import Ssh
code = "import sys, time; print('up', file=sys.stderr, flush=True); time.sleep(60)"
ssh = Ssh([sys.executable, "-c", code], 1)
while not ssh.said:
    ssh.poll()
    time.sleep(0.01)
print(ssh.pid, flush=True)
time.sleep(60)
"""


def test_it_does_not_outlive_a_process_that_is_killed() -> None:
    root = Path(__file__).parents[4]
    with subprocess.Popen([sys.executable, "-c", STATION], stdout=subprocess.PIPE, cwd=root) as station:
        assert station.stdout is not None
        pid = int(station.stdout.readline())
        assert alive(pid)
        station.kill()
        eventually(lambda: not alive(pid), "its end")
