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
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from runtime.core.backoff import BackOff
from runtime.core.errors import SetupError
from runtime.lerobot.devices import DeviceRefused, calibration_command, describe_error, make_device
from runtime.lerobot.features import UnusableValue
from runtime.lerobot.roles import ROLES, HostSettings, Role

_REFUSED = 2  # exit code: the settings are not valid
_LOST_S = 0.5  # time of nothing but errors after which the device is connected anew [s]
_PAUSE_S = 0.02  # after an error [s]
_END_S = 3.0  # time for a device to disconnect at the end [s]
_Report = Callable[[Mapping[str, Any]], None]


class Host:
    """Connection to one device: it is connected, read at the rate, and connected again when it is lost."""

    def __init__(self, settings: HostSettings, report: _Report, stop: threading.Event) -> None:
        self._settings, self._report, self._stop = settings, report, stop

    def run(self) -> None:
        """Serve the device until `stop` is set. Raises DeviceRefused, or SetupError for an endpoint."""
        device = make_device(self._settings.role, self._settings.device)
        role = self._make_role()  # after the imports, which keep threads from receiving commands
        try:
            back_off = BackOff(0.5, 5.0)
            while not self._stop.is_set():
                try:
                    self._serve(device, role, back_off)
                except DeviceRefused:
                    raise
                except Exception as error:  # of the device's own code
                    self._report({"problem": describe_error(error)})
                finally:
                    _disconnect(device)
                back_off.record_failure(time.monotonic())
                self._stop.wait(back_off.remaining_delay(time.monotonic()))
        finally:
            role.close()

    def _make_role(self) -> Role:
        try:
            return ROLES[self._settings.role](self._settings)
        except (ValueError, TypeError, ZeroDivisionError) as error:
            raise DeviceRefused(str(error)) from None

    def _serve(self, device: Any, role: Role, back_off: BackOff) -> None:
        """Connect the device and read it until it is lost or the host ends."""
        role.require(device)
        if self._settings.role == "camera":
            device.connect()
        else:
            device.connect(calibrate=False)  # calibrating asks a person at a terminal
            if not device.is_calibrated:
                command = calibration_command(self._settings.role, self._settings.device)
                self._report({"problem": f"the device is not calibrated; calibrate it by {command}"})
                return
        self._read(device, role, back_off)

    def _read(self, device: Any, role: Role, back_off: BackOff) -> None:
        """Read the device at the rate.

        A single error does not disconnect it: most devices switch their motors off when they are disconnected.
        """
        period = 1.0 / self._settings.rate
        due = good = time.monotonic()
        ready = False
        while not self._stop.is_set():
            try:
                role.step(device)
            except UnusableValue as error:
                self._report({"fault": error.fault, "text": str(error)})
            except Exception as error:  # of the device's own code
                self._report({"fault": "device_failed", "text": describe_error(error)})
                if time.monotonic() - good > _LOST_S:
                    raise
                self._stop.wait(_PAUSE_S)
            else:
                good = time.monotonic()
                if not ready:
                    ready = True
                    back_off.reset()
                    self._report({"problem": ""})
            if self._settings.role != "camera":  # a camera paces itself
                due += period * max(1, int((time.monotonic() - due) / period + 0.5))
                self._stop.wait(max(0.0, due - time.monotonic()))


def _disconnect(device: Any) -> None:
    with contextlib.suppress(Exception):  # of the device's own code
        if device.is_connected:
            device.disconnect()


def lock_device(table: Mapping[str, Any]) -> Any:
    """Return the lock of the device, a file that is open while this process has it.

    Two processes on one serial bus would read each other's answers, and LeRobot does not prevent it. A device is its
    `port`, or else its whole table.

    Raises:
        SetupError: Another process of this account has it.
    """
    port = table.get("port")
    whole = json.dumps(table, sort_keys=True, default=str)
    identity = os.path.realpath(port) if isinstance(port, str) else whole
    name = hashlib.sha256(identity.encode()).hexdigest()[:16]
    path = Path(tempfile.gettempdir()) / f"eva-lerobot-{os.getuid()}-{name}.lock"
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        file = os.fdopen(os.open(path, flags, 0o600), "r+")
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        device = port or table.get("type")
        raise SetupError(f"another process has the device {device} (`fuser {path}`): {error}") from None
    return file


def _read_line() -> tuple[dict[str, Any], _Report]:
    """Return the settings on standard input, and a function that writes reports to the present standard output.

    Afterwards standard output is standard error: LeRobot and drivers print what they like.
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
    settings: dict[str, Any] = json.loads(line)
    return settings, report


def _read_file(name: str) -> tuple[dict[str, Any], _Report]:
    import tomllib

    last = [""]

    def report(fields: Mapping[str, Any]) -> None:
        text = str(fields.get("text", fields.get("problem")))
        if text != last[0]:
            print(text or "the device is connected", file=sys.stderr, flush=True)
        last[0] = text

    return tomllib.loads(Path(name).read_text("utf-8")), report


def _end_with_input(stop: threading.Event, files: Sequence[str]) -> None:
    """End this process when standard input ends, after the device had a moment to disconnect."""
    while os.read(0, 4096):
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
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
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
        with lock_device(settings.device):
            Host(settings, report, stop).run()
            _remove(sockets)
    except (DeviceRefused, SetupError) as error:
        report({"problem": str(error)})
        return _REFUSED
    return 0


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stderr.flush()
    os._exit(code)  # threads of drivers must not prevent the end
