"""Episodes on their way from a station's computer: over real sockets, cut off, throttled, paused, kept and removed."""

import json
import os
import threading

import pytest

from runtime.core.errors import ConfigurationError
from runtime.ipc.session_state import SessionState
from runtime.link.contents import contents_of
from runtime.link.home import Home
from runtime.link.line import Dial
from runtime.link.uploads import Uploads, UploadSettings
from runtime.link.wire import EPISODES
from runtime.link.yielding import Throttle
from tests.processes import eventually
from tests.runtime.link.episodes import FILES, content, recorded, uuid_of
from tests.runtime.link.linked import STATION

FAST = UploadSettings(rate=50e6)
LAB_KEY = "ab" * 32


def receipt(robot, folder):
    """What the station has written down of it; None for nothing."""
    path = robot.data / "uploads" / STATION / f"{folder.name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def has_arrived(lab, robot, folder):
    eventually(lambda: receipt(robot, folder), "the lab's word that it has the episode")
    assert content(lab.data / "episodes" / folder.name) == content(folder)


def test_a_closed_episode_travels_and_an_open_one_does_not(lab, robot):
    opened = recorded(robot.data, STATION, 2, closed=False)
    other = recorded(robot.data, "bench-8", 3)
    closed = recorded(robot.data, STATION, 1)
    robot.dial(uploads=FAST)
    has_arrived(lab, robot, closed)
    assert receipt(robot, closed)["digest"] == contents_of(closed).digest
    (opened / "outcome.json").write_text("{}")
    has_arrived(lab, robot, opened)
    assert not (lab.data / "episodes" / other.name).exists()
    assert closed.exists()


def test_without_settings_nothing_travels_and_the_robot_is_linked(lab, robot):
    before = set(threading.enumerate())
    recorded(robot.data, STATION)
    robot.dial()
    lab.linked()
    assert lab.press().status == "done"
    assert "episodes" not in {thread.name for thread in set(threading.enumerate()) - before}


def test_a_lab_that_ends_in_the_middle_goes_on_from_there(lab, robot):
    folder = recorded(robot.data, STATION)
    ports = lab.gate.port, lab.gate.second_port
    robot.dial(uploads=UploadSettings(rate=150e3))
    partly = lab.data / "episodes" / ".arriving" / STATION / folder.name / "front.mp4"
    eventually(lambda: partly.exists() and partly.stat().st_size > 0, "its first bytes")
    lab.end()
    here = partly.read_bytes()
    assert 0 < len(here) < FILES["front.mp4"]
    inode = partly.stat().st_ino
    lab.begin(*ports)
    has_arrived(lab, robot, folder)
    assert (lab.data / "episodes" / folder.name / "front.mp4").stat().st_ino == inode  # of the same file


def test_a_link_that_ends_in_the_middle_goes_on_from_there(lab, robot):
    folder = recorded(robot.data, STATION)
    robot.dial(uploads=UploadSettings(rate=150e3))
    partly = lab.data / "episodes" / ".arriving" / STATION / folder.name / "front.mp4"
    eventually(lambda: partly.exists() and partly.stat().st_size > 0, "its first bytes")
    inode = partly.stat().st_ino
    robot.hang_up()
    robot.dial(uploads=FAST)
    has_arrived(lab, robot, folder)
    assert (lab.data / "episodes" / folder.name / "front.mp4").stat().st_ino == inode


@pytest.fixture
def waiting(lab, robot):
    """The station's end of episodes that wait for runs, under the test's hand."""
    robot.dial()
    lab.linked()
    dial = Dial(lab.known(STATION), robot.key, EPISODES, b"a test's session")
    made = Uploads(dial, robot.data / "stations" / STATION, UploadSettings(rate=50e6, waits=True))
    yield made
    made.close()


def test_a_run_that_goes_on_is_waited_for_where_that_is_asked_for(lab, robot, waiting):
    folder = recorded(robot.data, STATION)
    robot.station.ready()
    robot.station.do(lambda: robot.station.session._enter(SessionState.RUNNING, "run"))
    begun = lab.data / "episodes"

    def turned():
        robot.station.publish("state", {"state": robot.station.session.state, "recording": {"uuid": None}})
        waiting.turn(1)
        return waiting._line.up and waiting._runs._heard > waiting._runs._looked - 1.0

    eventually(turned, "the station's state")
    for _ in range(100):
        turned()
    assert not begun.exists()
    robot.station.do(lambda: robot.station.session._enter(SessionState.READY, "stopped"))
    eventually(lambda: turned() and receipt(robot, folder), "the episode")


def test_a_lab_without_room_is_told_of_once_and_asked_again(lab, robot, caplog):
    folder = recorded(robot.data, STATION)
    (lab.data / "episodes").mkdir()
    recorded(lab.data, "bench-1", 9, uuid=folder.name)
    robot.dial(uploads=FAST)
    eventually(lambda: "nothing is overwritten" in caplog.text, "the lab's reason at the station")
    assert receipt(robot, folder) is None
    assert folder.exists()


def test_labels_follow_their_episode_and_what_is_added_to_them(lab, robot):
    folder = recorded(robot.data, STATION)
    here, there = (data / "labels" / f"{folder.name}.jsonl" for data in (robot.data, lab.data))
    here.parent.mkdir()
    here.write_bytes(b"one\n")
    robot.dial(uploads=FAST)
    eventually(lambda: there.exists() and there.read_bytes() == b"one\n", "its labels")
    here.write_bytes(b"one\ntwo\n")
    eventually(lambda: there.read_bytes() == b"one\ntwo\n", "the label that was added")


def test_what_the_lab_has_compared_is_removed_at_home_where_that_is_asked_for(lab, robot):
    folder = recorded(robot.data, STATION)
    whole = content(folder)
    robot.dial(uploads=UploadSettings(rate=50e6, keep_days=0.0))
    eventually(lambda: not folder.exists(), "the removal")
    assert content(lab.data / "episodes" / folder.name) == whole
    eventually(lambda: receipt(robot, folder)["removed"], "the receipt")
    assert list((robot.data / "episodes").glob("*/*")) == []


# --- what a station's computer keeps -------------------------------------------------------------------------


class Clock:
    now = 1000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def home_of(tmp_path, clock, keep_days=None, lab=LAB_KEY):
    return Home(tmp_path, STATION, lab, keep_days, clock, clock)


def test_the_newest_is_offered_first_and_one_that_was_declined_waits(tmp_path, clock):
    for seed in (1, 2, 3):
        os.utime(recorded(tmp_path, STATION, seed) / "outcome.json", (seed, seed))
    home = home_of(tmp_path, clock)
    assert home.next() == uuid_of(3)
    home.put_off(uuid_of(3), 60.0)
    assert home.next() == uuid_of(2)
    clock.now += 61.0
    assert home.next() == uuid_of(3)


def test_what_another_lab_has_compared_this_one_does_not_have(tmp_path, clock):
    folder = recorded(tmp_path, STATION)
    home_of(tmp_path, clock).arrived(folder.name, contents_of(folder))
    assert home_of(tmp_path, clock).next() == ""
    assert home_of(tmp_path, clock, lab="cd" * 32).next() == folder.name


def test_a_receipt_that_cannot_be_read_is_none(tmp_path, clock, caplog):
    folder = recorded(tmp_path, STATION)
    home_of(tmp_path, clock).arrived(folder.name, contents_of(folder))
    path = tmp_path / "uploads" / STATION / f"{folder.name}.json"
    path.write_text("{")
    assert home_of(tmp_path, clock).next() == folder.name
    assert "is no receipt" in caplog.text


def test_nothing_is_removed_unless_that_is_asked_for_nor_before_its_time(tmp_path, clock):
    folder = recorded(tmp_path, STATION)
    home_of(tmp_path, clock).arrived(folder.name, contents_of(folder))
    clock.now += 100 * 86400.0
    assert home_of(tmp_path, clock).next() == ""
    assert home_of(tmp_path, clock, keep_days=100.1).next() == ""
    due = home_of(tmp_path, clock, keep_days=100.0)
    assert due.next() == folder.name  # to be compared once more
    assert folder.exists()
    due.arrived(folder.name, contents_of(folder))
    assert not folder.exists()
    assert due.next() == ""


def test_one_that_has_changed_since_the_lab_compared_it_is_not_removed(tmp_path, clock):
    folder = recorded(tmp_path, STATION)
    home = home_of(tmp_path, clock, keep_days=1.0)
    home.arrived(folder.name, contents_of(folder))
    clock.now += 2 * 86400.0
    (folder / "events.jsonl").write_bytes(b"more")
    home.arrived(folder.name, contents_of(folder))
    assert folder.exists()


def test_a_removal_that_was_killed_is_finished_by_the_next_start(tmp_path, clock):
    folder = recorded(tmp_path, STATION)
    home_of(tmp_path, clock).arrived(folder.name, contents_of(folder))
    leaving = tmp_path / "episodes" / ".leaving" / folder.name
    leaving.parent.mkdir()
    folder.rename(leaving)
    home_of(tmp_path, clock)
    assert not leaving.exists()


def test_a_bucket_lets_through_its_rate_and_no_more(clock):
    bucket = Throttle(1000.0, 500.0, clock)
    sent = 0
    for _ in range(1000):
        clock.now += 0.01
        while not bucket.wait_s():
            bucket.consume(64)
            sent += 64
    assert 10_000 <= sent <= 10_000 + 500 + 64


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("EVA_UPLOAD_MB_S", value) for value in ("0", "-1", "51", "fast", "nan")),
        *(("EVA_KEEP_DAYS", value) for value in ("-1", "never", "nan", "inf")),
        ("EVA_UPLOAD_WAITS", "perhaps"),
    ],
)
def test_a_setting_that_cannot_be_used_is_named_with_what_is_allowed(name, value):
    with pytest.raises(ConfigurationError, match=f"{name} = '{value}'; allowed: "):
        UploadSettings.read({name: value})


def test_settings_have_defaults_and_are_read():
    assert UploadSettings.read({}) == UploadSettings(10e6, waits=False, keep_days=None)
    given = {"EVA_UPLOAD_MB_S": "2.5", "EVA_UPLOAD_WAITS": "yes", "EVA_KEEP_DAYS": "30"}
    assert UploadSettings.read(given) == UploadSettings(2.5e6, waits=True, keep_days=30.0)
