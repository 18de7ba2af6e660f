"""Follower of a long-running command: it renews the lease while the terminal runs; Ctrl-C stops the command."""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from runtime.clients.client import Refused, StationClient
from runtime.clients.terminal.keys import Keys, NoKeys, keys
from runtime.clients.terminal.status_text import distance_text, status_line

# Commands that continue after they were accepted, and the condition of the session meanwhile.
LASTING = {
    "setup": "preparing",
    "home": "preparing",
    "approach": "preparing",
    "run": "going",
    "resume": "going",
}
_KEYS = {"\n": "step", "c": "commit", "x": "cancel", "q": "stop"}
_KEYED = {  # meaning of the keys, by mode of the run
    "step": "Enter: next chunk, x: cancel, q: stop",
    "preview": "Enter: next chunk, c: commit, x: cancel, q: stop",
    "manual": "x: end the motion, q: stop; move, jog and gripper from another terminal",
}
_LOOK_S = 0.05
_SHOW_S = 0.5


EventCallback = Callable[[str], None]


def follow_command(
    client: StationClient, kind: str, arguments: dict[str, Any], tell: EventCallback
) -> dict[str, Any]:
    """Send a long-running command and report its progress until it is over; Ctrl-C sends `stop`.

    Returns:
        The status at the end.
    """
    pressed = threading.Event()
    # KeyboardInterrupt raised inside a destructor is lost; a Ctrl-C that stops a robot must not be, so it sets a flag.
    before = signal.signal(signal.SIGINT, lambda *_: pressed.set())
    try:
        client.command(kind, **arguments)
        status = client.status()
        with _keys_of(kind, status) as keyboard:
            progress = _PeriodicLine(tell) if isinstance(keyboard, NoKeys) else _KeyLine(tell, status["mode"])
            while status["state_is"][LASTING[kind]]:
                if pressed.is_set():
                    raise KeyboardInterrupt
                client.renew()
                progress.show(status)
                _press(client, keyboard.key(_LOOK_S))
                status = client.status()
            return status
    except KeyboardInterrupt:
        client.command("stop")
        return client.status()
    finally:
        signal.signal(signal.SIGINT, before)


def _keys_of(kind: str, status: dict[str, Any]) -> Keys:
    """Return the keyboard for a run in which a person decides about steps, else NoKeys."""
    if LASTING[kind] != "going" or status["mode"] not in _KEYED:
        return NoKeys()
    return keys()


def _press(client: StationClient, key: str) -> None:
    """Send the command of a key, if it has one; a refusal is printed and the run continues."""
    if key not in _KEYS:
        return
    try:
        client.command(_KEYS[key])
    except Refused as refusal:
        print(f"refused: {refusal}", file=sys.stderr, flush=True)


class _PeriodicLine:
    """Line of figures, printed at most every `_SHOW_S`."""

    def __init__(self, tell: EventCallback) -> None:
        self._tell = tell
        self._shown = -math.inf

    def show(self, status: dict[str, Any]) -> None:
        if time.monotonic() - self._shown > _SHOW_S:
            self._shown = time.monotonic()
            self._tell(status_line(status))


class _KeyLine(_PeriodicLine):
    """Line that is printed at each change, with the available keys if the run waits for a person."""

    def __init__(self, tell: EventCallback, mode: str) -> None:
        super().__init__(tell)
        self._keys = _KEYED[mode]
        self._last: tuple[Any, ...] = ()

    def show(self, status: dict[str, Any]) -> None:
        now = (status["state"], status["phase"], status["proposal"].get("chunk"))
        if now == self._last:
            return
        self._last = now
        self._tell(status_line(status))
        if status["phase"] in ("waiting", "proposed"):
            text = distance_text(status["proposal"], "the chunk that is shown")
            self._tell(f"  {text + '  ' if text else ''}[{self._keys}]")
