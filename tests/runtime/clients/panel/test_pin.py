"""The PIN: how it is kept, and how often it may be guessed."""

from __future__ import annotations

import stat

import pytest

from runtime.clients.panel import pin as pins
from runtime.clients.panel.pin import Attempts, PinFile
from runtime.clients.panel.sessions import LASTS_S, Refusal, Sessions
from runtime.core.clock import VirtualClock
from runtime.core.errors import ConfigurationError


@pytest.fixture(autouse=True)
def _cheap(monkeypatch):
    monkeypatch.setattr(pins, "_COST", {"n": 2, "r": 1, "p": 1})


@pytest.fixture
def pin(tmp_path):
    made = PinFile(tmp_path / "bench-1")
    made.set("271828")
    return made


@pytest.fixture
def clock():
    return VirtualClock(1000.0)


def test_a_pin_is_kept_as_a_hash_that_this_account_alone_can_read(pin):
    assert "271828" not in pin.path.read_text()
    assert stat.S_IMODE(pin.path.stat().st_mode) == 0o600
    assert pin.matches("271828")
    assert not pin.matches("271829")
    assert [one.name for one in pin.path.parent.iterdir()] == ["panel.pin"]


@pytest.mark.parametrize("given", ["12345", "", "x" * 65])
def test_a_pin_that_is_too_short_or_too_long_is_none(pin, given):
    with pytest.raises(ConfigurationError, match=f"has {len(given)} characters; allowed: 6 to 64"):
        pin.set(given)
    assert pin.matches("271828")


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"salt": "zz", "hash": "00", "n": 2, "r": 1, "p": 1}'])
def test_a_file_that_is_of_no_use_lets_nobody_in(pin, content):
    pin.path.write_text(content)
    with pytest.raises(ConfigurationError, match="set a PIN again"):
        pin.matches("271828")


def test_a_file_that_others_can_read_lets_nobody_in(pin):
    pin.path.chmod(0o640)
    with pytest.raises(ConfigurationError, match="can be read by others"):
        pin.matches("271828")


def test_wrong_pins_of_one_source_make_it_wait_twice_as_long_each_time(clock):
    attempts = Attempts(clock.now)
    waits = []
    for _ in range(13):
        attempts.failed("10.0.0.7")
        waits.append(attempts.wait("10.0.0.7"))
        clock.advance(waits[-1])
    assert waits == [0, 0, 2, 4, 8, 16, 32, 64, 128, 256, 300, 300, 300]
    attempts.failed("10.0.0.7")
    assert attempts.wait("10.0.0.8") == 0
    attempts.passed("10.0.0.7")
    assert attempts.wait("10.0.0.7") == 0


def test_wrong_pins_of_many_sources_make_all_of_them_wait(clock):
    attempts = Attempts(clock.now)
    for number in range(19):
        attempts.failed(f"10.0.0.{number}")
        assert attempts.wait("10.0.1.1") == 0
    attempts.failed("10.0.0.19")
    assert attempts.wait("10.0.1.1") == 2
    for number in range(20, 40):
        attempts.failed(f"10.0.0.{number}")
    assert attempts.wait("10.0.1.1") == 60
    attempts.passed("10.0.1.1")  # the right one of somebody else gives nobody more guesses
    assert attempts.wait("10.0.1.1") == 60
    clock.advance(3601.0)
    assert attempts.wait("10.0.1.1") == 0


def test_many_sources_are_not_kept_for_ever(clock):
    attempts = Attempts(clock.now)
    for number in range(5000):
        attempts.failed(str(number))
    assert len(attempts._sources) == 1000


def test_a_session_ends_with_its_time_and_with_the_pin(pin, clock):
    sessions = Sessions(pin, Attempts(clock.now), clock.now)
    secret = sessions.begin("271828", "a")
    assert sessions.holds(secret)
    assert not sessions.holds("")
    clock.advance(LASTS_S)
    assert not sessions.holds(secret)
    secret = sessions.begin("271828", "a")
    pin.set("314159")
    assert not sessions.holds(secret)
    secret = sessions.begin("314159", "a")
    sessions.end(secret)
    assert not sessions.holds(secret)


def test_the_right_pin_is_not_looked_at_while_its_source_waits(pin, clock):
    sessions = Sessions(pin, Attempts(clock.now), clock.now)
    for _ in range(3):
        with pytest.raises(Refusal, match="wrong PIN"):
            sessions.begin("000000", "a")
    with pytest.raises(Refusal, match="too many wrong PINs: wait 2 s; the E-STOP needs none") as refused:
        sessions.begin("271828", "a")
    assert refused.value.wait_s == 2
    clock.advance(2.0)
    assert sessions.holds(sessions.begin("271828", "a"))


def test_without_a_pin_nobody_is_let_in(tmp_path, clock):
    sessions = Sessions(PinFile(tmp_path), Attempts(clock.now), clock.now)
    with pytest.raises(Refusal, match="no PIN is set on the station's computer"):
        sessions.begin("", "a")
