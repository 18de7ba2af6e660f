"""A computer becomes a station over the wire, with the code that its lab has shown."""

import threading

import pytest

from runtime import keys
from runtime.core.errors import ConfigurationError, TransportError
from runtime.link import codes, key_files
from runtime.link.enrolling import Enrolling
from runtime.link.enrolment import enrol
from runtime.link.wire import Enrol
from tests.processes import PATIENCE_S, eventually
from tests.runtime.link.linked import STATION, allowed


@pytest.fixture
def key(tmp_path):
    return key_files.make_station_key(tmp_path / "robot")


def address(lab):
    return f"127.0.0.1:{lab.gate.port}"


def test_a_computer_is_enrolled_and_knows_its_lab(lab, tmp_path, key, capsys):
    lab.allowed.now = allowed(enrolling=True)
    words = ["--data-dir", str(tmp_path / "robot"), "enrol", address(lab), lab.code(STATION).text()]
    assert keys.main(words) == 0
    assert f"{STATION} is a station of the test's lab now" in capsys.readouterr().out
    known = key_files.known_lab(tmp_path / "robot" / "stations" / STATION)
    assert known == lab.known(STATION)
    ((_, asked, _),) = lab.asked
    assert asked == key.public.hex()


def test_a_code_is_good_once(lab, tmp_path, key):
    lab.allowed.now = allowed(enrolling=True)
    code = lab.code(STATION)
    enrol(tmp_path / "robot", address(lab), code, key, PATIENCE_S)
    with pytest.raises(ConfigurationError, match="does not enrol this computer: this code is not known"):
        enrol(tmp_path / "robot", address(lab), code, key, PATIENCE_S)


def test_a_computer_of_a_station_may_be_another_one_too(lab, tmp_path, key):
    lab.allowed.now = allowed((key, STATION))
    assert enrol(tmp_path / "robot", address(lab), lab.code("bench-8"), key, PATIENCE_S).station == "bench-8"


def test_an_unknown_computer_is_not_let_in_while_no_code_is_open(lab, tmp_path, key, monkeypatch):
    monkeypatch.setattr("runtime.link.enrolment._HEARD_S", 0.0)
    with pytest.raises(ConfigurationError, match="no code is open there"):
        enrol(tmp_path / "robot", address(lab), lab.code(STATION), key, PATIENCE_S)
    assert lab.asked == []


def test_who_answers_without_the_key_in_the_code_is_told_nothing(lab, tmp_path, key):
    """A man in the middle has another key: the handshake fails before the secret is sent."""
    lab.allowed.now = allowed(enrolling=True)
    code = codes.Code(key_files.KeyPair.from_secret(bytes(range(32))).public, lab.code(STATION).secret)
    with pytest.raises(TransportError, match="no answer from a lab with the key in this code"):
        enrol(tmp_path / "robot", address(lab), code, key, 1.0)
    assert lab.asked == []


def test_guesses_are_few_in_a_minute(lab, tmp_path, key):
    lab.allowed.now = allowed(enrolling=True)
    made_up = codes.fresh(lab.key.public)
    said = []
    for _ in range(11):
        with pytest.raises(ConfigurationError) as caught:
            enrol(tmp_path / "robot", address(lab), made_up, key, PATIENCE_S)
        said.append(str(caught.value))
    assert all("is not known" in one for one in said[:10])
    assert "more than 10 tries to enrol within a minute" in said[10]
    assert len(lab.asked) == 10


def test_an_unknown_computer_may_do_nothing_but_enrol(lab, robot, caplog):
    """While a code is open any key is let in: it is no station, whatever name it gives."""
    lab.allowed.now = allowed(enrolling=True)
    robot.dial()
    eventually(lambda: "not known here with this key" in caplog.text, "the refusal")
    assert lab.gate.linked() == set()
    assert not lab.folder().exists()


@pytest.mark.parametrize("name", ["../../elsewhere", "", "a/b", "bench\x00", "b" * 64])
def test_what_a_lab_calls_a_station_is_a_folder_of_stations_and_no_path(lab, tmp_path, key, name):
    lab.allowed.now = allowed(enrolling=True)
    with pytest.raises(ConfigurationError, match=r"names it .*; allowed: letters, digits"):
        enrol(tmp_path / "robot", address(lab), lab.code(name), key, PATIENCE_S)
    assert not list(tmp_path.rglob("lab.json"))


def test_who_guesses_keeps_nobody_elsewhere_from_enrolling():
    asked = []
    enrolling = Enrolling(lambda *given: asked.append(given) or "no", lambda: 1000.0)
    said = []
    for number in range(40):
        said.append(enrolling.request(b"%d" % number, "10.0.0.66", "66", Enrol(1, "0", b"guess")))
        most = min(number + 1, 10)
        eventually(lambda most=most: len(asked) == most, "what is asked")
    assert said == [""] * 10 + ["more than 10 tries to enrol within a minute: wait for a minute"] * 30
    assert enrolling.request(b"r", "10.0.0.7", "07", Enrol(1, "0", b"a code")) == ""
    enrolling.end()


def test_a_code_stays_good_where_the_database_comes_back_too_late_and_an_end_waits_for_none():
    now, gone, asked = [1000.0], threading.Event(), []

    def enrol_(*given):
        asked.append(given)
        gone.wait(PATIENCE_S)
        return "no"

    enrolling = Enrolling(enrol_, lambda: now[0])
    for number in range(3):
        enrolling.request(b"%d" % number, "10.0.0.7", "07", Enrol(1, "0", b"a code"))
    eventually(lambda: asked, "the first")
    now[0] += 6.0
    gone.set()
    found = []
    eventually(lambda: found.extend(enrolling.answers()) or len(found) == 3, "all answers")
    assert [answer for _, answer in found[1:]] == ["the lab cannot look the code up now: try again"] * 2
    assert len(asked) == 1
    enrolling.end()
