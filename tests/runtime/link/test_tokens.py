"""Tokens: whose they are, for how long on the station's clock, and once."""

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from runtime.link.tokens import VALID_S, Challenges, Signer
from runtime.link.wire import Ask

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
PAYLOAD = b"a command"
RECORDED = (
    "b58ac6fc801fa2f299670a94d26568289298c2f035af843de64f1d9e205f4dd2"
    "0000e13ed8628bea8c1479ee4ed28117d9cd02e237277e82c77e52f14bbb3d0d"
)


class Clock:
    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def station(clock):
    return Challenges("bench-7", KEY.public_key(), clock)


def signed(challenge, payload=PAYLOAD, station="bench-7", key=KEY, process="coordinator", socket="commands"):
    serial, signature = Signer(key).token(station, challenge, f"{process}/{socket}", payload)
    return Ask(1, process, socket, False, challenge, serial, signature)


def test_a_token_is_good_once(station):
    ask = signed(station.newest())
    assert station.wrong(ask, PAYLOAD) == ""
    assert "used before" in station.wrong(ask, PAYLOAD)


def test_the_same_command_given_again_has_another_token(station):
    challenge = station.newest()
    signer = Signer(KEY)
    for _ in range(3):
        serial, signature = signer.token("bench-7", challenge, "coordinator/commands", PAYLOAD)
        ask = Ask(1, "coordinator", "commands", False, challenge, serial, signature)
        assert station.wrong(ask, PAYLOAD) == ""


def test_validity_is_counted_on_the_stations_own_clock_from_its_challenge(station, clock):
    challenge = station.newest()
    clock.now += VALID_S
    assert station.wrong(signed(challenge), PAYLOAD) == ""
    clock.now += 0.001
    assert "more than 3 s on its way" in station.wrong(signed(challenge), PAYLOAD)
    assert station.wrong(signed(station.newest()), PAYLOAD) == ""


def test_challenges_of_before_a_restart_are_none(clock):
    before = Challenges("bench-7", KEY.public_key(), clock).newest()
    after = Challenges("bench-7", KEY.public_key(), clock)
    after.newest()
    assert "on its way" in after.wrong(signed(before), PAYLOAD)


def test_a_command_without_a_token_names_nobody(station):
    assert "names no user" in station.wrong(Ask(1, "coordinator", "commands"), PAYLOAD)


@pytest.mark.parametrize(
    "changed",
    [
        {"payload": b"another command"},
        {"station": "bench-8"},
        {"key": Ed25519PrivateKey.from_private_bytes(bytes(32))},
        {"process": "guard"},
        {"socket": "estop"},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_a_token_is_for_one_command_to_one_socket_of_one_station_of_one_lab(station, changed):
    ask = signed(station.newest(), **changed)
    same = Ask(1, "coordinator", "commands", False, ask.challenge, ask.serial, ask.signature)
    assert "not this lab's" in station.wrong(same, PAYLOAD)


@pytest.mark.parametrize("serial", [-1, 1 << 63, 1 << 70])
def test_a_serial_that_cannot_be_is_refused(station, serial):
    ask = signed(station.newest())
    other = Ask(1, "coordinator", "commands", False, ask.challenge, serial, ask.signature)
    assert "not this lab's" in station.wrong(other, PAYLOAD)


def test_challenges_that_are_over_are_forgotten(station, clock):
    for _ in range(1000):
        clock.now += 0.2
        station.newest()
    assert len(station._made) <= VALID_S / 0.2 + 2


def test_a_token_that_was_recorded_from_release_1_is_verified(clock, monkeypatch):
    """What is signed is part of the wire: neither end may change it alone."""
    challenge = bytes(range(16))
    monkeypatch.setattr("runtime.link.tokens.secrets.token_bytes", lambda size: challenge)
    station = Challenges("bench-7", KEY.public_key(), clock)
    assert station.newest() == challenge
    assert (
        station.wrong(Ask(1, "guard", "estop", True, challenge, 42, bytes.fromhex(RECORDED)), PAYLOAD) == ""
    )
