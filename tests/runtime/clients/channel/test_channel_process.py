"""`python -m runtime.clients.channel`, by itself and started by a station."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from runtime.clients.channel import __main__ as channel
from runtime.clients.channel.server import HOST
from runtime.config.schema import ControlChannelSettings
from runtime.core.errors import TransportError
from runtime.ipc.bus import Endpoints
from tests.processes import alive, eventually
from tests.runtime.clients.channel.bench import Script

DEMO = Path(__file__).parents[4] / "deployments" / "demo.toml"


def test_a_station_that_is_not_known_here_is_a_sentence(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(channel.log, "configure_logging", lambda process: None)
    assert channel.main(["nowhere", "--data-dir", str(tmp_path)]) == 2
    assert "station 'nowhere' is not known here" in capsys.readouterr().err


def test_by_itself_no_station_listens_for_scripts():
    assert ControlChannelSettings().enabled is False
    assert HOST == "127.0.0.1"


def test_a_port_that_is_taken_is_told_once_and_tried_again_until_it_is_free(tmp_path, monkeypatch, caplog):
    taken = socket.create_server((HOST, 0))
    port = taken.getsockname()[1]
    looks = []

    def pause(seconds):
        looks.append(seconds)
        if len(looks) == 3:
            taken.close()

    monkeypatch.setattr(channel.time, "sleep", pause)
    ended = iter([False] * 5 + [True] * 5)
    channel.serve(tmp_path, ControlChannelSettings(port=port), lambda: next(ended))
    told = [record.message for record in caplog.records if "cannot listen" in record.message]
    assert told == [
        f"the control channel cannot listen on {HOST}:{port}: Address already in use; name another port with "
        "control_channel.port; tried again every second"
    ]
    assert len(looks) == 3
    assert Endpoints(tmp_path).read("channel")["control"] == f"tcp://{HOST}:{port}"


def test_who_is_ended_before_there_is_a_port_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(channel.time, "sleep", lambda _: None)
    with socket.create_server((HOST, 0)) as taken:
        settings = ControlChannelSettings(port=taken.getsockname()[1])
        ended = iter([False, False, True])
        channel.serve(tmp_path, settings, lambda: next(ended))
    with pytest.raises(TransportError):
        Endpoints(tmp_path).read("channel")


@pytest.mark.lab
@pytest.mark.slow
def test_a_station_starts_its_channel_again_where_it_dies_and_takes_it_along(tmp_path):
    sets = [f'data_dir="{tmp_path}"', "control_channel.enabled=true", "control_channel.port=0"]
    options = [part for one in sets for part in ("--set", one)]
    station = subprocess.Popen(
        [sys.executable, "-m", "runtime", str(DEMO), *options, "--lifeline"],
        stdin=subprocess.PIPE,
        cwd=DEMO.parents[1],
    )
    endpoints = Endpoints(tmp_path / "stations" / "demo")
    try:
        first = eventually(lambda: found(endpoints), "the channel")
        assert asked(first["control"])["state"] == "disconnected"
        os.kill(first["pid"], signal.SIGKILL)
        second = eventually(lambda: newer(endpoints, first), "another channel")
        assert asked(second["control"])["station"] == "demo"
        assert station.poll() is None
        station.kill()  # and nothing of it is left
        eventually(lambda: not alive(second["pid"]), "the end of the channel")
    finally:
        station.kill()
        station.wait()
        assert station.stdin is not None
        station.stdin.close()


def found(endpoints):
    try:
        return endpoints.read("channel")
    except TransportError:
        return None


def newer(endpoints, first):
    now = found(endpoints)
    return now if now and now["pid"] != first["pid"] else None


def asked(endpoint):
    """The station's snapshot over the channel, as soon as the coordinator answers."""
    script = Script(endpoint, {})
    try:
        return eventually(lambda: script.send(query="station").get("data"), "coordinator")
    finally:
        script.close()
