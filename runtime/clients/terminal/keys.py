"""Single keys of the terminal, where there is a person at it."""

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
    """A pause that a key can end; to be entered, and left whatever happens."""

    @abstractmethod
    def key(self, seconds: float) -> str:
        """The key that is pressed within so many seconds, "" for none."""

    @abstractmethod
    def __enter__(self) -> Keys: ...

    @abstractmethod
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the terminal as it was found."""


class NoKeys(Keys):
    """Nobody is there to press one."""

    def __enter__(self) -> NoKeys:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def key(self, seconds: float) -> str:
        """Wait."""
        time.sleep(seconds)
        return ""


class Keyboard(Keys):
    """Keys of a terminal at once, without Enter and without an echo; Ctrl-C remains Ctrl-C."""

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
        """The next key, Enter as a newline; a terminal that has hung up presses none."""
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
    """The keyboard, where standard input is a terminal that this process is in the foreground of."""
    try:
        descriptor = sys.stdin.fileno()
        ours = os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp()
    except (OSError, ValueError, AttributeError):  # no standard input, or one that is no file
        ours = False
    return Keyboard(descriptor) if ours else NoKeys()
