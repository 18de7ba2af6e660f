import threading

import pytest
import zmq

from runtime.core import msgpack_arrays
from runtime.simulation import drives
from runtime.simulation.drives import Drives, DriveSwitch
from runtime.transports.node_messages import DRIVE_FAULTS_LIMIT
from tests.processes import PATIENCE_MS

GOOD = {"enabled": True, "faults": []}


def test_drives_are_on_unless_there_is_a_fault():
    assert Drives().status() == GOOD
    assert Drives(False).status() == {"enabled": False, "faults": []}
    assert Drives(True, ["hot"]).status() == {"enabled": False, "faults": ["hot"]}


def test_a_fault_switches_them_off_and_switching_on_clears_it():
    switched = Drives()
    switched.apply(DriveSwitch(False, "hot"))
    switched.apply(DriveSwitch(False))
    assert switched.status() == {"enabled": False, "faults": ["hot"]}
    switched.apply(DriveSwitch(True))
    assert switched.status() == GOOD


def test_of_endless_faults_the_newest_are_kept():
    switched = Drives()
    for number in range(DRIVE_FAULTS_LIMIT + 5):
        switched.apply(DriveSwitch(False, f"fault {number}"))
    assert switched.status()["faults"][-1] == f"fault {DRIVE_FAULTS_LIMIT + 4}"
    assert len(switched.status()["faults"]) == DRIVE_FAULTS_LIMIT


@pytest.mark.parametrize(
    ("word", "fields", "switch"),
    [
        ("drives_enable", {}, DriveSwitch(True)),
        ("drives_disable", {}, DriveSwitch(False)),
        ("drives_fault", {"fault": "hot"}, DriveSwitch(False, "hot")),
        ("drives_fault", {}, None),
        ("drives_fault", {"fault": ""}, None),
        ("drives_fault", {"fault": 7}, None),
        ("drives_fault", {"fault": "x" * 201}, None),
    ],
)
def test_words_are_read(word, fields, switch):
    assert drives.parse_switch(word, fields) == switch


def test_a_word_is_said_once_the_node_listens():
    node = zmq.Context.instance().socket(zmq.SUB)
    try:
        node.setsockopt(zmq.SUBSCRIBE, b"")
        node.bind("tcp://127.0.0.1:*")
        endpoint = node.getsockopt(zmq.LAST_ENDPOINT).rstrip(b"\0").decode()
        heard = []
        thread = threading.Thread(target=lambda: heard.append(node.recv() if node.poll(PATIENCE_MS) else b""))
        thread.start()
        assert drives.main(["fault", "--fault", "hot", "--action-endpoint", endpoint]) == 0
        thread.join()
        assert msgpack_arrays.unpack(heard[0]) == {"t": 0.0, "target": "drives_fault", "fault": "hot"}
    finally:
        node.close(linger=0)


def test_where_no_node_listens_that_is_said(monkeypatch, capsys):
    monkeypatch.setattr(drives, "_PATIENCE_S", 0.02)
    assert drives.main(["disable", "--action-endpoint", "tcp://127.0.0.1:1"]) == 1
    assert "no node listens at tcp://127.0.0.1:1" in capsys.readouterr().err
