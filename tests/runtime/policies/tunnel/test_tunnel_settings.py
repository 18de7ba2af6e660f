"""What a tunnel may say, and what becomes of it on ssh's command line."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from runtime.core.errors import ConfigurationError
from runtime.policies.tunnel.command import command, far_end, require_files
from runtime.policies.tunnel.settings import TunnelSettings, is_host

FAR = ("127.0.0.1", 8000)


def line(**settings: Any) -> list[str]:
    return command("/usr/bin/ssh", TunnelSettings(host="gpu-1.lab", **settings), 40001, FAR)


def options(given: list[str]) -> dict[str, str]:
    found = [given[place + 1] for place, word in enumerate(given) if word == "-o"]
    return dict(option.split("=", 1) for option in found)


def test_a_host_alone_is_a_tunnel_without_questions_or_other_forwardings() -> None:
    found = line()
    assert found[:4] == ["/usr/bin/ssh", "-T", "-a", "-x"]
    assert found[-5:] == ["-L", "127.0.0.1:40001:127.0.0.1:8000", "--", "gpu-1.lab", "cat"]
    assert options(found) == {
        "BatchMode": "yes",
        "NumberOfPasswordPrompts": "0",
        "ExitOnForwardFailure": "yes",
        "ControlMaster": "no",
        "ControlPath": "none",
        "PermitLocalCommand": "no",
        "RemoteCommand": "none",
        "UpdateHostKeys": "no",
        "TCPKeepAlive": "yes",
        "ServerAliveCountMax": "3",
        "ConnectionAttempts": "1",
        "LogLevel": "INFO",
        "StrictHostKeyChecking": "yes",
        "ServerAliveInterval": "5",
        "ConnectTimeout": "10",
    }
    assert not {"-l", "-p", "-i", "-J", "-F"} & set(found)


def test_without_a_session_nothing_is_run_there() -> None:
    found = line(session=False)
    assert found[:6] == ["/usr/bin/ssh", "-T", "-a", "-x", "-N", "-n"]
    assert found[-2:] == ["--", "gpu-1.lab"]


def test_whatever_is_said_is_an_argument_of_its_own() -> None:
    found = line(
        user="lab",
        port=2222,
        identity_file="~/.ssh/id_lab",
        jump=["gate.lab", "me@[fe80::1]:2200"],
        host_keys="accept-new",
        known_hosts_file="/etc/lab/known hosts",
        ssh_config="none",
        alive_interval=9,
        connect_deadline=2.5,
    )
    assert found[4:6] == ["-F", "none"]
    rest = found[found.index("-l") : -3]
    home = os.path.expanduser("~")
    assert rest[:4] == ["-l", "lab", "-p", "2222"]
    assert rest[4:8] == ["-i", f"{home}/.ssh/id_lab", "-o", "IdentitiesOnly=yes"]
    assert rest[8:10] == ["-J", "gate.lab,me@[fe80::1]:2200"]
    said = options(found)
    assert said["StrictHostKeyChecking"] == "accept-new"
    assert said["UserKnownHostsFile"] == '"/etc/lab/known hosts"'
    assert (said["ServerAliveInterval"], said["ConnectTimeout"]) == ("9", "3")


def test_ssh_itself_reads_it_so() -> None:
    found = line(user="lab", port=2222, jump=["me@gate.lab:2200"], known_hosts_file="/etc/lab/known hosts")
    try:
        told = subprocess.run(
            ["ssh", "-G", "-F", "none", *found[1:]], capture_output=True, text=True, check=True
        )
    except FileNotFoundError:
        pytest.skip("ssh is not installed")
    said = dict(row.partition(" ")[::2] for row in told.stdout.splitlines())
    assert (said["host"], said["user"], said["port"]) == ("gpu-1.lab", "lab", "2222")
    assert (said["batchmode"], said["stricthostkeychecking"], said["exitonforwardfailure"]) == (
        *("yes", "true", "yes"),
    )
    assert said["localforward"] == "[127.0.0.1]:40001 [127.0.0.1]:8000"
    assert said["proxyjump"] == "me@gate.lab:2200"
    assert said["userknownhostsfile"] == "/etc/lab/known hosts"
    assert said["controlmaster"] == "false"


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"host": "-oProxyCommand=reboot"}, "host's name"),
        ({"host": "gpu 1"}, "host's name"),
        ({"host": "gpu;reboot"}, "host's name"),
        ({"host": "$(reboot)"}, "host's name"),
        ({"host": "gpu\n"}, "host's name"),
        ({"host": ""}, "host's name"),
        ({"host": "lab@gpu"}, "host's name"),
        ({"host": "fe80::1%eth0"}, "host's name"),
        ({"user": "-lroot"}, "account's name"),
        ({"user": "a b"}, "account's name"),
        ({"user": "`id`"}, "account's name"),
        ({"jump": ["-oProxyCommand=reboot"]}, "user@gateway.lab"),
        ({"jump": ["a,b"]}, "user@gateway.lab"),
        ({"jump": ["gate:0"]}, "user@gateway.lab"),
        ({"jump": ["gate:70000"]}, "user@gateway.lab"),
        ({"jump": ["x@y@gate"]}, None),
        ({"jump": ["gate';id'"]}, "user@gateway.lab"),
        ({"jump": "gate"}, "list"),
        ({"identity_file": "-i"}, "path from the root or from home"),
        ({"identity_file": "id_lab"}, "path from the root or from home"),
        ({"identity_file": "~other/id"}, "path from the root or from home"),
        ({"identity_file": "/k/%h"}, "mean something to ssh"),
        ({"identity_file": "/k/${HOME}"}, "mean something to ssh"),
        ({"known_hosts_file": '/k/"x'}, "mean something to ssh"),
        ({"ssh_config": "config"}, "path from the root or from home"),
        ({"host_keys": "no"}, "strict"),
        ({"port": 0}, "greater than or equal to 1"),
        ({"port": "22"}, "integer"),
        ({"alive_interval": 0}, "greater than or equal to 1"),
        ({"connect_deadline": float("inf")}, "finite"),
        ({"password": "hunter2"}, "Extra inputs"),
    ],
)
def test_what_could_be_an_option_or_a_command_is_refused(
    settings: dict[str, Any], sentence: str | None
) -> None:
    if sentence is None:
        assert TunnelSettings(**{"host": "gpu", **settings}).jump == settings["jump"]
        return
    with pytest.raises(ValidationError, match=sentence):
        TunnelSettings(**{"host": "gpu", **settings})


@pytest.mark.parametrize("key", ["-----BEGIN OPENSSH PRIVATE KEY-----\nb3Bl", "PRIVATE KEY", "/a\nb"])
def test_a_key_in_the_place_of_its_path_is_refused_as_a_secret(key: str) -> None:
    with pytest.raises(ValidationError) as refused:
        TunnelSettings(host="gpu", identity_file=key)
    [error] = refused.value.errors()
    assert error["type"] == "secret"
    assert "path of a file" in error["msg"]
    assert key not in error["msg"]


@given(st.text(max_size=40))
def test_no_host_begins_with_a_dash_or_means_anything_to_a_shell(name: str) -> None:
    if is_host(name):
        assert not name.startswith("-")
        assert not set(name) & set(" \t\r\n\"'`$&|;<>(){}[]*?!#~\\%@,=/")


@pytest.mark.parametrize(
    ("settings", "where"),
    [
        ({"host": "gpu"}, "gpu"),
        ({"host": "gpu", "user": "lab"}, "lab@gpu"),
        ({"host": "fe80::1", "user": "lab", "port": 2222}, "lab@[fe80::1]:2222"),
    ],
)
def test_sentences_name_the_far_end(settings: dict[str, Any], where: str) -> None:
    assert TunnelSettings(**settings).where == where


@pytest.mark.parametrize(
    ("url", "far"),
    [
        ("ws://127.0.0.1:8000/path?x=1", ("127.0.0.1", 8000)),
        ("ws://gpu.lab", ("gpu.lab", 80)),
        ("wss://gpu.lab/path", ("gpu.lab", 443)),
        ("tcp://[::1]:5555", ("::1", 5555)),
        ("grpc://localhost:8080", ("localhost", 8080)),
    ],
)
def test_the_far_end_is_what_the_url_says(url: str, far: tuple[str, int]) -> None:
    assert far_end(url) == far
    end = command("ssh", TunnelSettings(host="gpu", session=False), 1, far)[-3]
    assert end == f"127.0.0.1:1:{'[::1]' if far[0] == '::1' else far[0]}:{far[1]}"


@pytest.mark.parametrize(
    "url", ["ws://a b:80", "ws://a:99999", "ws://-x:80", "tcp://gpu", "ws://:80", "ws://[::1"]
)
def test_other_urls_lead_nowhere(url: str) -> None:
    with pytest.raises(ConfigurationError, match=r"policy\.url = .*allowed: "):
        far_end(url)


def test_files_have_to_be_there(tmp_path: Path) -> None:
    there, absent = tmp_path / "there", str(tmp_path / "absent")
    there.write_text("")
    for name in ("identity_file", "known_hosts_file", "ssh_config"):
        require_files(TunnelSettings(host="gpu", **{name: str(there)}))
        with pytest.raises(ConfigurationError, match=rf"policy\.tunnel\.{name} = .*no such file"):
            require_files(TunnelSettings(host="gpu", **{name: absent}))
    require_files(
        TunnelSettings(host="gpu", host_keys="accept-new", known_hosts_file=absent, ssh_config="none")
    )
