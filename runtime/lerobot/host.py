"""Host of a LeRobot device: `PYTHON -m runtime.lerobot.host [FILE.toml]`, run by the Python of LeRobot's environment.

The environment needs lerobot, numpy, pyzmq and msgpack; of ours it sees the package runtime alone. A robot is an
execution node on the wire of `kind = "zmq"`, a teleoperator a leader, a camera a publisher of pictures. A station
starts the host without a file: the settings are the first line of standard input, whose end ends the host. Standard
output then carries the host's reports, one JSON object per line. With a file, it can run on any computer by itself.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import hashlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from runtime.core.errors import SetupError
from runtime.lerobot.devices import (
    LOST,
    DeviceLost,
    DeviceRefused,
    calibration_command,
    describe_error,
    make_device,
)
from runtime.lerobot.features import UnusableValue
from runtime.lerobot.roles import ROLES, HostSettings, Role

_REFUSED = 2  # exit code: the settings are not valid
_LOST_ERRORS, _LOST_S = 3, 0.5  # errors, and time from the first of them [s], after which a device is lost
_SILENT_S = 5.0  # time of nothing usable after which it is lost [s]
_LIFELINE = 100  # descriptor, above those that are open already
_NEWS_S = 0.5  # for commands to arrive [s]
_AGAIN_S = 5.0  # pause before a host with a file connects its device again [s]
_PAUSE_S = 0.02  # after an error [s]
_END_S = 3.0  # time for a device to disconnect at the end [s]
_RESOURCES = ("index_or_path", "serial_number_or_name", "remote_ip", "robot_ip", "ip")
_Report = Callable[[Mapping[str, Any]], None]


class Host:
    """One connection to one device, which is read at the rate.

    A device that is lost needs a new process: after a failure many drivers neither work nor connect again.
    """

    def __init__(self, settings: HostSettings, report: _Report, stop: threading.Event) -> None:
        self._settings, self._report, self._stop = settings, report, stop

    def run(self) -> None:
        """Serve the device until `stop` is set.

        Raises:
            DeviceRefused: The device cannot be made as the settings say.
            SetupError: An endpoint cannot be bound.
            DeviceLost: It cannot be connected, is not calibrated, or is lost.
        """
        device = make_device(self._settings.role, self._settings.device)
        role = self._make_role()  # after the imports, which keep threads from receiving commands
        try:
            self._wait_for_release(role)
            if not self._stop.is_set():
                self._serve(device, role)
        except (DeviceRefused, DeviceLost):
            raise
        except Exception as error:  # of the device's own code
            raise DeviceLost(describe_error(error)) from error
        finally:
            self._disconnect(device)
            role.close()

    def _make_role(self) -> Role:
        try:
            return ROLES[self._settings.role](self._settings)
        except (ValueError, TypeError, ZeroDivisionError) as error:
            raise DeviceRefused(str(error)) from None

    def _wait_for_release(self, role: Role) -> None:
        """Wait while the station's commands say that its e-stop is engaged; after a start they need a moment."""
        self._stop.wait(_NEWS_S)
        if role.are_stopped:
            self._report(
                {"problem": "it is connected when the e-stop is released: that may switch its motors on"}
            )
        while role.are_stopped and not self._stop.is_set():
            self._stop.wait(_PAUSE_S)

    def _serve(self, device: Any, role: Role) -> None:
        """Connect the device and read it until it is lost or the host ends."""
        role.require(device)
        if self._settings.role == "camera":
            device.connect()
        else:
            device.connect(calibrate=False)  # calibrating asks a person at a terminal
            if not device.is_calibrated:
                command = calibration_command(self._settings.role, self._settings.device)
                raise DeviceLost(f"the device is not calibrated; calibrate it by {command}")
        self._read(device, role)

    def _read(self, device: Any, role: Role) -> None:
        """Read the device at the rate, and let it execute commands.

        A single error, however long it takes, does not disconnect the device: most switch their motors off then. An
        error of a command alone never does.
        """
        period = 1.0 / self._settings.rate
        due = given = time.monotonic()
        failures: list[float] = []  # times of the errors since the last answer
        ready = False
        while not self._stop.is_set():
            try:
                gives = role.step(device)
            except UnusableValue as error:
                failures.clear()
                self._report({"fault": error.fault, "text": str(error)})
            except Exception as error:  # of the device's own code
                failures.append(time.monotonic())
                self._report({"fault": "device_failed", "text": describe_error(error)})
                if len(failures) >= _LOST_ERRORS and failures[-1] - failures[0] > _LOST_S:
                    raise
                self._stop.wait(_PAUSE_S)
            else:
                failures.clear()
                if gives:
                    given = time.monotonic()
                if gives and not ready:
                    ready = True
                    self._report({"problem": ""})
            if time.monotonic() - given > _SILENT_S and not failures:
                raise DeviceLost(f"it has given nothing for {_SILENT_S:g} s")
            self._command(device, role)
            if self._settings.role != "camera":  # a camera paces itself
                due += period * max(1, int((time.monotonic() - due) / period + 0.5))
                self._stop.wait(max(0.0, due - time.monotonic()))

    def _command(self, device: Any, role: Role) -> None:
        try:
            role.command(device)
        except Exception as error:  # of the device's own code
            self._report({"fault": "command_failed", "text": describe_error(error)})

    def _disconnect(self, device: Any) -> None:
        """Disconnect the device as far as it goes; what fails is reported, because its motors may still be on."""
        try:
            if device.is_connected:
                device.disconnect()
        except Exception as error:  # of the device's own code
            self._report({"fault": "disconnect_failed", "text": describe_error(error)})


def lock_device(table: Mapping[str, Any]) -> list[Any]:
    """Return the locks of the device's resources, files that are open while this process has them.

    Two processes on one serial bus would read each other's answers, and LeRobot does not prevent it. Resources are all
    ports, camera indices and addresses in the table, of whatever arm or camera; without any it is the whole table.

    Raises:
        SetupError: Another process of this account has one of them.
    """
    folder = Path("/run/lock")  # the same for all processes of the account, unlike that of $TMPDIR
    if not os.access(folder, os.W_OK):
        folder = Path("/tmp")
    files = []
    for resource in sorted({*_find_resources(table)}) or [json.dumps(table, sort_keys=True, default=str)]:
        name = hashlib.sha256(resource.encode()).hexdigest()[:16]
        path = folder / f"eva-lerobot-{os.getuid()}-{name}.lock"
        try:
            file = os.fdopen(
                os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600), "r+"
            )
            files.append(file)
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise SetupError(
                f"another process has the device {resource:.100} (`fuser {path}`): {error}"
            ) from None
    return files


def _find_resources(table: Mapping[str, Any]) -> Iterator[str]:
    """Yield what no two processes may have, wherever it is in the table."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _find_resources(value)
        elif isinstance(value, str) and (key == "port" or key.endswith("_port")):
            yield os.path.realpath(value)
        elif key in _RESOURCES and isinstance(value, str | int):
            is_camera = key == "index_or_path"
            yield (
                os.path.realpath(f"/dev/video{value}" if isinstance(value, int) else value)
                if is_camera
                else f"{value}"
            )


def _read_line() -> tuple[dict[str, Any], _Report]:
    """Return the settings on standard input, and a function that writes reports to the present standard output.

    Afterwards standard output is standard error: LeRobot and drivers print what they like. Standard input is empty, so
    that a driver that asks a person fails at once; the station's end is seen at the descriptor _LIFELINE.
    """
    reports = os.dup(1)
    os.dup2(2, 1)

    def report(fields: Mapping[str, Any]) -> None:
        with contextlib.suppress(OSError):  # the station is gone, and so is this process soon
            os.write(reports, json.dumps(fields).encode() + b"\n")

    line = b""
    while not line.endswith(b"\n"):
        part = os.read(0, 1)
        if not part:
            raise SystemExit(_REFUSED)
        line += part
    os.dup2(0, _LIFELINE, inheritable=False)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    settings: dict[str, Any] = json.loads(line)
    return settings, report


def _read_file(name: str) -> tuple[dict[str, Any], _Report]:
    import tomllib

    last: list[str] = []

    def report(fields: Mapping[str, Any]) -> None:
        text = str(fields.get("text", fields.get("problem")))
        if [text] != last:
            print(text or "the device is connected", file=sys.stderr, flush=True)
        last[:] = [text]

    try:
        return tomllib.loads(Path(name).read_text("utf-8")), report
    except (OSError, ValueError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        raise SystemExit(_REFUSED) from None


def _end_with_input(stop: threading.Event, files: Sequence[str]) -> None:
    """End this process when standard input ends, after the device had a moment to disconnect."""
    while os.read(_LIFELINE, 4096):
        pass
    stop.set()
    time.sleep(_END_S)
    _remove(files)  # the device does not return
    os._exit(1)


def _remove(sockets: Sequence[str]) -> None:
    """Remove the sockets and their folder, which is the host's own."""
    for socket in sockets:
        with contextlib.suppress(OSError):  # the station has removed them
            Path(socket).unlink(missing_ok=True)
    for socket in sockets:
        with contextlib.suppress(OSError):
            Path(socket).parent.rmdir()


def main(arguments: Sequence[str]) -> int:
    """Serve a device until SIGTERM, SIGINT or the end of standard input."""
    parser = argparse.ArgumentParser(
        prog="python -m runtime.lerobot.host", description="Host of one LeRobot device."
    )
    parser.add_argument(
        "file", nargs="?", help="TOML file with the settings; without it, a station starts this"
    )
    file = parser.parse_args(arguments).file
    stop = threading.Event()

    def end(*_: object) -> None:
        if not stop.is_set():
            stop.set()
            overdue = threading.Timer(_END_S, os._exit, (1,))  # a device that hangs prevents no end
            overdue.daemon = True
            overdue.start()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)
    table, report = _read_file(file) if file else _read_line()
    sockets: list[str] = []
    try:
        settings = HostSettings.from_table(table)
        if not file:
            sockets = [
                end.removeprefix("ipc://") for end in (settings.observations, settings.commands) if end
            ]
            lifeline = threading.Thread(target=_end_with_input, args=(stop, sockets), daemon=True)
            lifeline.start()
        locks = lock_device(settings.device)
        Host(settings, report, stop).run()
        _remove(sockets)
        for lock in locks:
            lock.close()
    except (DeviceRefused, SetupError) as error:
        report({"problem": str(error)})
        return _REFUSED
    except DeviceLost as lost:
        report({"problem": str(lost)})
        if not file:
            return LOST
        if not stop.wait(_AGAIN_S):
            sys.stderr.flush()
            os.execv(sys.executable, [sys.executable, "-m", "runtime.lerobot.host", file])
    return 0


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stderr.flush()
    os._exit(code)  # threads of drivers must not prevent the end
