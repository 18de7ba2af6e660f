import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from evaweb.lab import lifetime
from evaweb.lab.lab import open_lab
from evaweb.lab.processes import LabError
from tests.processes import PATIENCE_S


def test_a_taken_port_names_the_option_and_leaves_its_holder_alone():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(
            LabError, match=rf"cannot listen on 127.0.0.1:{port}: .*; name another port with --port"
        ):
            lifetime.require_free("127.0.0.1", port)
        assert other.fileno() > 0


def test_a_port_that_stops_cannot_have_ends_a_lab_before_anything_starts(tmp_path, settings):
    settings.DATA_DIR = tmp_path
    with _listening_above_a_free_one() as other:
        port = other.getsockname()[1]
        for ports in ((0, port), (port - 1, None)):
            with (
                pytest.raises(LabError, match=rf":{port}: .* with --stop-port"),
                open_lab("127.0.0.1", *ports),
            ):
                pass
    assert list(tmp_path.iterdir()) == []


def _listening_above_a_free_one():
    """Below the ports that are given out to whoever asks for any: another test would take the free one."""
    for port in range(20_001 + os.getpid() % 5000, 32_000):
        with suppress(OSError, LabError):
            lifetime.require_free("127.0.0.1", port - 1)
            return socket.create_server(("127.0.0.1", port))
    raise AssertionError("no two ports are free")


def test_a_free_port_stays_free_after_the_look():
    with socket.socket() as mine:
        mine.bind(("127.0.0.1", 0))
        port = mine.getsockname()[1]
    lifetime.require_free("127.0.0.1", port)
    with socket.socket() as mine:
        mine.bind(("127.0.0.1", port))
        assert mine.getsockname()[1] == port


def test_a_second_lab_on_the_same_folder_is_refused_with_the_first_ones_number(tmp_path):
    with (
        lifetime.hold_data_folder(tmp_path),
        pytest.raises(LabError, match=f"process {os.getpid()}"),
        lifetime.hold_data_folder(tmp_path),
    ):
        pass
    with lifetime.hold_data_folder(tmp_path):
        assert (tmp_path / "lab.lock").read_text() == str(os.getpid())


ENDS = """
import signal, sys, time
from evaweb.lab import lifetime
if "ignored" in sys.argv:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
lifetime.end_on_signals()
try:
    try:
        print("up", flush=True)
        time.sleep(60)
    except Exception:
        print("caught on the way", flush=True)
except lifetime.StopRequested:
    print("ending", flush=True)
    sys.stdin.readline()
    print("ended", flush=True)
"""


@pytest.fixture
def ending():
    made = []

    def start(*arguments):
        made.append(
            subprocess.Popen(
                [sys.executable, "-c", ENDS, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                cwd=Path(__file__).parents[3],
            )
        )
        assert made[-1].stdout.readline() == "up\n"
        return made[-1]

    yield start
    for one in made:
        one.kill()
        one.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_each_way_to_end_a_lab_lets_it_end_in_order_and_a_second_one_changes_nothing(ending, number):
    lab = ending()
    lab.send_signal(number)
    assert lab.stdout.readline() == "ending\n"
    for another in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        lab.send_signal(another)
    assert lab.communicate("\n", timeout=PATIENCE_S) == ("ended\n", None)
    assert lab.returncode == 0


def test_a_lab_that_is_to_outlive_its_terminal_does(ending):
    lab = ending("ignored")
    lab.send_signal(signal.SIGHUP)
    lab.send_signal(signal.SIGTERM)
    assert lab.stdout.readline() == "ending\n"
    lab.send_signal(signal.SIGHUP)
    assert lab.communicate("\n", timeout=PATIENCE_S) == ("ended\n", None)
