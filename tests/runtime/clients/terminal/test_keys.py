import contextlib
import os
import pty
import sys
import termios

import pytest

from runtime.clients.terminal import keys as module
from runtime.clients.terminal.keys import Keyboard, NoKeys, keys
from tests.processes import PATIENCE_S


@pytest.fixture
def terminal():
    """[the person's end, the program's end] of a terminal; what a test closes itself it takes out."""
    ends = list(pty.openpty())
    yield ends
    for end in ends:
        os.close(end)


def test_a_key_is_there_without_enter_and_enter_is_one(terminal):
    person, program = terminal
    with Keyboard(program) as keyboard:
        os.write(person, b"c")
        assert keyboard.key(PATIENCE_S) == "c"
        os.write(person, b"\r")
        assert keyboard.key(PATIENCE_S) == "\n"
        assert keyboard.key(0.0) == ""


def test_the_terminal_is_left_as_it_was(terminal):
    program = terminal[1]
    before = termios.tcgetattr(program)
    with contextlib.suppress(KeyError), Keyboard(program):
        assert termios.tcgetattr(program) != before
        raise KeyError
    assert termios.tcgetattr(program) == before


def test_a_terminal_that_hangs_up_presses_nothing(terminal):
    with Keyboard(terminal[1]) as keyboard:
        os.close(terminal.pop(0))
        assert keyboard.key(PATIENCE_S) == ""
        assert keyboard.key(0.0) == ""


def test_without_a_terminal_there_are_no_keys(monkeypatch):
    with open(os.devnull) as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        assert isinstance(keys(), NoKeys)
    monkeypatch.setattr(sys, "stdin", None)
    assert isinstance(keys(), NoKeys)
    with NoKeys() as none:
        assert none.key(0.0) == ""


def test_in_the_background_of_a_terminal_there_are_none_either(monkeypatch, terminal):
    with os.fdopen(os.dup(terminal[1])) as program:
        monkeypatch.setattr(sys, "stdin", program)
        monkeypatch.setattr(module.os, "tcgetpgrp", lambda descriptor: os.getpgrp() + 1)
        assert isinstance(keys(), NoKeys)
        monkeypatch.setattr(module.os, "tcgetpgrp", lambda descriptor: os.getpgrp())
        assert isinstance(keys(), Keyboard)
