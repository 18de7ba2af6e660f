"""Single keys of the terminal, if a person uses the terminal."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
import tty
from abc import ABC, abstractmethod
from types import TracebackType


class Keys(ABC):
    """Source of single key presses; as a context manager it restores the terminal at the end."""

    @abstractmethod
    def key(self, seconds: float) -> str:
        """Return the key that is pressed within `seconds` [s], "" if none is."""

    @abstractmethod
    def __enter__(self) -> Keys: ...

    @abstractmethod
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Restore the terminal."""


class NoKeys(Keys):
    """Source of keys without a keyboard: no key is ever pressed."""

    def __enter__(self) -> NoKeys:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def key(self, seconds: float) -> str:
        """Wait for `seconds` [s] and return ""."""
        time.sleep(seconds)
        return ""


class Keyboard(Keys):
    """Keyboard of a terminal, read at once, without Enter and without echo; Ctrl-C keeps its meaning."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._hung_up = False

    def __enter__(self) -> Keyboard:
        self._before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._hung_up:
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def key(self, seconds: float) -> str:
        """Return the next key, Enter as a newline; "" if the terminal has hung up."""
        if self._hung_up:
            time.sleep(seconds)
            return ""
        readable, _, _ = select.select([self._descriptor], [], [], seconds)
        if not readable:
            return ""
        try:
            pressed = os.read(self._descriptor, 1)
        except OSError:
            pressed = b""
        self._hung_up = not pressed
        return pressed.decode("latin-1").replace("\r", "\n")


def keys() -> Keys:
    """Return the keyboard if this process is in the foreground of a terminal, else NoKeys."""
    try:
        descriptor = sys.stdin.fileno()
        is_foreground = os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp()
    except (OSError, ValueError, AttributeError):  # standard input is closed or not a file
        is_foreground = False
    return Keyboard(descriptor) if is_foreground else NoKeys()
