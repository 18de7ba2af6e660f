"""Where the sockets are: in a folder of the account's own, or nowhere."""

from __future__ import annotations

import os
import socket
import stat
from pathlib import Path

import pytest

from runtime.core.errors import TransportError
from runtime.ipc.endpoints import (
    LONGEST,
    Endpoints,
    connection_problem,
    file_identity,
    new_socket_path,
    socket_folder,
)


@pytest.fixture
def runtime_dir(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path_factory.mktemp("r")
    folder.chmod(0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder


def mode(folder: Path) -> int:
    return stat.S_IMODE(folder.stat().st_mode)


def test_the_folder_is_this_accounts_alone_whatever_the_umask(runtime_dir: Path, tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        folder = socket_folder(tmp_path / "bench")
    finally:
        os.umask(before)
    assert folder.parent == runtime_dir / "eva-web"
    assert (mode(folder), mode(folder.parent)) == (0o700, 0o700)


@pytest.mark.parametrize("given", ["", "/nowhere/at/all"])
def test_without_a_folder_of_the_session_it_is_at_home(
    given: str, runtime_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", given)
    monkeypatch.setenv("HOME", str(runtime_dir))
    folder = socket_folder(tmp_path / "bench")
    assert folder.parent == runtime_dir / ".cache" / "eva-web-run"
    assert (mode(folder), mode(folder.parent)) == (0o700, 0o700)


def test_two_stations_of_one_name_in_different_data_folders_do_not_meet(
    runtime_dir: Path, tmp_path: Path
) -> None:
    assert socket_folder(tmp_path / "one" / "bench") != socket_folder(tmp_path / "two" / "bench")
    (tmp_path / "link").symlink_to(tmp_path / "one")
    assert socket_folder(tmp_path / "one" / "bench") == socket_folder(tmp_path / "link" / "bench")


def test_a_long_name_makes_no_longer_path(runtime_dir: Path, tmp_path: Path) -> None:
    station = tmp_path.joinpath(*["x" * 60] * 5)
    assert len(os.fsencode(new_socket_path(station, "commands"))) <= LONGEST


def test_a_folder_whose_sockets_would_have_too_long_paths_is_refused(
    runtime_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = LONGEST - len("/eva-web/") - 16 - len("/commands-01234567")
    fits = runtime_dir / ("x" * (room - len(os.fsencode(runtime_dir)) - 1))
    too_long = fits.with_name(fits.name + "x")
    for folder in (fits, too_long):
        folder.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(fits))
    assert len(os.fsencode(new_socket_path(tmp_path, "commands"))) == LONGEST
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(too_long))
    with pytest.raises(TransportError, match=r"up to 108 bytes; allowed: 107; set XDG_RUNTIME_DIR"):
        socket_folder(tmp_path)


@pytest.mark.parametrize("allowed", [0o755, 0o770, 0o701])
def test_a_folder_that_others_can_enter_is_refused_with_its_mode(
    runtime_dir: Path, tmp_path: Path, allowed: int
) -> None:
    (runtime_dir / "eva-web").mkdir()
    (runtime_dir / "eva-web").chmod(allowed)
    with pytest.raises(
        TransportError, match=rf"{runtime_dir}/eva-web is .* mode {allowed:04o}: .*allowed: 0700"
    ):
        socket_folder(tmp_path)


def test_a_link_that_somebody_made_in_its_place_is_refused(runtime_dir: Path, tmp_path: Path) -> None:
    (runtime_dir / "eva-web").symlink_to(tmp_path)
    with pytest.raises(TransportError, match="must be a folder, and no link"):
        socket_folder(tmp_path)


def test_a_folder_of_another_account_is_refused_by_name(
    runtime_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (runtime_dir / "eva-web").mkdir(mode=0o700)
    monkeypatch.setattr(os, "geteuid", lambda: 4711)
    with pytest.raises(TransportError, match=rf"{runtime_dir} .* belongs to .*allowed: a folder of uid 4711"):
        socket_folder(tmp_path)


def test_a_session_folder_in_which_others_may_write_is_refused(runtime_dir: Path, tmp_path: Path) -> None:
    runtime_dir.chmod(0o777)
    with pytest.raises(TransportError, match="has the mode 0777"):
        socket_folder(tmp_path)


def test_what_dead_processes_left_of_a_socket_is_removed_by_the_next(
    runtime_dir: Path, tmp_path: Path
) -> None:
    left, other = new_socket_path(tmp_path, "commands"), new_socket_path(tmp_path, "state")
    left.touch()
    other.touch()
    assert new_socket_path(tmp_path, "commands") != left
    assert (left.exists(), other.exists()) == (False, True)
    Endpoints(tmp_path).clear()
    assert list((runtime_dir / "eva-web").iterdir()) == []


def test_a_file_that_somebody_removes_is_missed(
    runtime_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("runtime.ipc.endpoints.time.monotonic", lambda: now)
    endpoints = Endpoints(tmp_path)
    endpoints.write("guard", {"estop": "ipc://x"})
    now = 2.0
    assert not endpoints.is_missing("guard")
    (tmp_path / "endpoints" / "guard.json").unlink()
    assert not endpoints.is_missing("guard"), "it has looked just now"
    now = 4.0
    assert endpoints.is_missing("guard")


@pytest.mark.parametrize("spoiled", [b"", b"garbage", b"5", b"[]", b"{}", b"\xff", b"[" * 200_000])
def test_a_file_that_holds_something_else_is_missed(
    runtime_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoiled: bytes
) -> None:
    now = 0.0
    monkeypatch.setattr("runtime.ipc.endpoints.time.monotonic", lambda: now)
    endpoints = Endpoints(tmp_path)
    endpoints.write("guard", {"estop": "ipc://x"})
    (tmp_path / "endpoints" / "guard.json").write_bytes(spoiled)
    now = 2.0
    assert endpoints.is_missing("guard")
    assert endpoints.address("guard", "estop") == ""
    if spoiled != b"{}":
        with pytest.raises(TransportError, match="is not running here"):
            endpoints.read("guard")
    successor = Endpoints(tmp_path)
    successor.write("guard", {"estop": "ipc://y"})
    now = 4.0
    assert not endpoints.is_missing("guard"), "what another process says of itself stays"
    assert endpoints.address("guard", "estop") == "ipc://y"


# --- what happens to the folder while a station runs -------------------------------------------------------


def test_a_station_that_runs_goes_elsewhere_where_its_folder_is_of_no_use_and_says_so(
    runtime_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    home = runtime_dir.with_name(f"{runtime_dir.name}h")
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    station = runtime_dir / "s"
    station.mkdir()
    runtime_dir.chmod(0o777)
    assert new_socket_path(station, "estop").is_relative_to(home)
    assert "has the mode 0777" in caplog.text
    (home / ".cache").rename(home / "away")
    (home / ".cache").symlink_to(tmp_path / "nowhere")
    assert new_socket_path(station, "estop").parent == station / "sockets"
    with pytest.raises(TransportError, match="mode 0777"):
        Endpoints(station).prepare()
    Endpoints(station).clear()
    assert not (station / "sockets").exists()


@pytest.mark.parametrize("what", ["removed", "another file", "open to others", "the folder is gone"])
def test_a_socket_that_clients_cannot_trust_to_be_there_is_none(runtime_dir: Path, what: str) -> None:
    folder = runtime_dir / "f"
    folder.mkdir(0o700)
    path = folder / "estop-1"
    path.touch()
    before = file_identity(path)
    if what == "removed":
        path.unlink()
    elif what == "another file":
        (folder / "other").touch()
        (folder / "other").replace(path)
    elif what == "open to others":
        folder.chmod(0o755)
    else:
        folder.rename(runtime_dir / "g")
    assert before != (0, 0)
    assert file_identity(path) != before


def test_what_is_wrong_with_a_socket_is_said_with_what_to_do(runtime_dir: Path) -> None:
    path = runtime_dir / "estop-1"
    assert connection_problem(f"ipc://{path}").startswith(
        f"{path}: no process listens there (No such file or directory): where"
    )
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        assert "Connection refused" in connection_problem(f"ipc://{path}")
        listening.listen(1)
        assert connection_problem(f"ipc://{path}") == ""


def test_a_file_that_the_disk_does_not_give_up_ends_nobody(tmp_path, caplog):
    """A gate withdraws one whenever a link is lost: on a disk that takes no more, every station's went with it."""
    (tmp_path / "endpoints" / "coordinator.json").mkdir(parents=True)
    Endpoints(tmp_path).withdraw("coordinator")
    assert "clients still find the process coordinator" in caplog.text
