"""kill -9 of a station whose policy server is behind a tunnel: no ssh is left, and nobody else's is touched."""

import subprocess

import pytest

from runtime.policies.tunnel.ssh_process import free_port
from tests.processes import alive, eventually
from tests.ssh import SshServer, required

pytestmark = pytest.mark.slow


@pytest.fixture
def ssh_server(tmp_path):
    required()
    server = SshServer(tmp_path / "ssh", free_port()).start()
    yield server
    server.stop()


def children(pid, name):
    """Of one process, those of a name."""
    found = subprocess.run(["ps", "-o", "pid=,comm=", "--ppid", str(pid)], capture_output=True, text=True)
    return [int(line.split()[0]) for line in found.stdout.splitlines() if line.split()[1] == name]


def up_through_a_tunnel(lab, ssh_server):
    """A station that is set up; the process of its tunnel."""
    lab.ready(policy={"tunnel": ssh_server.settings()})
    [ssh] = children(lab.pids()["coordinator"], "ssh")
    return ssh


@pytest.fixture
def bystander(ssh_server):
    """Somebody else's ssh to the same host, by the same account."""
    settings = ssh_server.settings()
    files = [
        "-F",
        "none",
        "-i",
        settings["identity_file"],
        "-o",
        f"UserKnownHostsFile={settings['known_hosts_file']}",
    ]
    line = [
        "ssh",
        *files,
        "-N",
        "-p",
        str(settings["port"]),
        "-L",
        f"127.0.0.1:{free_port()}:127.0.0.1:1",
        "127.0.0.1",
    ]
    with subprocess.Popen(line, stdin=subprocess.DEVNULL) as process:
        eventually(lambda: len(ssh_server.sessions()) == 1, "its connection")
        yield process
        assert process.poll() is None
        process.terminate()


@pytest.mark.parametrize(
    "victims",
    [
        ["coordinator"],
        ["supervisor"],
        ["supervisor", "coordinator", "control", "reception", "media", "guard"],
    ],
)
def test_no_tunnel_outlives_what_was_killed(station, ssh_server, bystander, victims):
    lab = station.rest(kills=1)
    ssh = up_through_a_tunnel(lab, ssh_server)
    assert alive(ssh)
    for process in victims:
        lab.kill(process)
    eventually(lambda: not alive(ssh), "the end of ssh")
    if victims == ["coordinator"]:  # another one makes its own at the next set-up
        lab.answers_again()
        lab.reach("idle")
        up_through_a_tunnel(lab, ssh_server)
        [again] = children(lab.pids()["coordinator"], "ssh")
        assert again != ssh
    assert bystander.poll() is None
