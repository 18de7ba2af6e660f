import errno
import mmap

import pytest

from runtime.clock import VirtualClock
from runtime.guard import Guard
from runtime.latch import Latch
from runtime.messages import Command
from runtime.page import EStop, Page, PageLayout

LAYOUT = PageLayout(dim=2, eef_dim=8, cameras=())
PERIOD = 1 / 30


class Control:
    """A clock on whose every wait control ticks, and obeys the flag where it is alive."""

    def __init__(self, page):
        self.page, self.alive, self.slept = page, True, 0.0
        self.clock = VirtualClock(100.0)
        self.now = self.clock.now

    def sleep_until(self, deadline):
        self.clock.sleep_until(deadline)
        if self.alive:
            self.tick()

    def tick(self):
        status = self.page.control.read().copy()
        status["estop_obeyed"] = self.page.estop is EStop.LATCHED
        self.page.control.write(status)


class FailingLatch(Latch):
    def __init__(self, folder):
        super().__init__(folder)
        self.fails = True

    def set(self, by, why):
        if self.fails:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().set(by, why)

    def clear(self):
        if self.fails:
            raise OSError(errno.EROFS, "Read-only file system")
        super().clear()


@pytest.fixture
def page():
    return Page(LAYOUT, mmap.mmap(-1, Page.size(LAYOUT)))


@pytest.fixture
def latch(tmp_path):
    tmp_path.joinpath("bench-1").mkdir()
    return Latch(tmp_path / "bench-1")


@pytest.fixture
def control(page):
    return Control(page)


@pytest.fixture
def guard(page, latch, control):
    return Guard(page, latch, control, PERIOD, "bench-1")


def press(guard, **changes):
    return guard.answer(Command("u", "estop", {"why": "arm too low"}, **({"user": "anna"} | changes)))


def test_a_guard_that_finds_no_latch_lets_commands_pass(guard, page):
    assert page.estop is EStop.CLEAR


def test_a_station_latched_before_its_start_starts_latched(page, latch, control):
    latch.set("anna", "yesterday")
    Guard(page, latch, control, PERIOD)
    assert page.estop is EStop.LATCHED


def test_a_latch_that_cannot_be_read_starts_latched(page, latch, control, tmp_path):
    (tmp_path / "bench-1" / "estop.json").write_text("{", "utf-8")
    Guard(page, latch, control, PERIOD)
    assert page.estop is EStop.LATCHED


def test_a_press_raises_the_flag_and_is_on_disk(guard, page, latch):
    ack = press(guard)
    assert (ack.uuid, ack.status) == ("u", "done")
    assert ack.reason == "every tick now sends the measured position"
    assert page.estop is EStop.LATCHED
    assert (latch.read().by, latch.read().why) == ("anna", "arm too low")


@pytest.mark.parametrize(
    ("changes", "by"),
    [({}, "anna"), ({"user": "", "holder": "page-7"}, "page-7"), ({"user": "", "holder": ""}, "unknown")],
)
def test_anybody_may_press_and_is_named_as_far_as_known(guard, latch, changes, by):
    assert press(guard, **changes).status == "done"
    assert latch.read().by == by


def test_the_flag_is_raised_before_the_disk_is_touched(page, control, latch, monkeypatch):
    seen = []
    guard = Guard(page, latch, control, PERIOD)
    monkeypatch.setattr(latch, "set", lambda *_: seen.append(page.estop))
    press(guard)
    assert seen == [EStop.LATCHED]


def test_nothing_is_logged_before_the_flag_the_disk_and_the_answer(guard, page, latch, caplog):
    ack = press(guard)
    assert (ack.status, caplog.text) == ("done", "")
    guard.watch()
    assert "E-STOP by anna: arm too low" in caplog.text
    caplog.clear()
    guard.watch()
    assert caplog.text == ""


def test_a_disk_that_fails_does_not_keep_the_flag_down(page, control, tmp_path):
    guard = Guard(page, FailingLatch(tmp_path), control, PERIOD)
    ack = press(guard)
    assert page.estop is EStop.LATCHED
    assert ack.status == "done"
    assert ack.reason.endswith(
        "not on disk (No space left on device): a restart of the station may forget it"
    )


def test_a_control_that_does_not_answer_means_the_hardware_stop(guard, page, control, latch):
    control.alive = False
    begun = control.now()
    ack = press(guard)
    assert ack.status == "failed"
    assert ack.reason == "latched, but control has not obeyed within 67 ms: USE THE HARDWARE STOP"
    assert control.now() - begun == pytest.approx(2 * PERIOD, abs=0.003)
    assert page.estop is EStop.LATCHED
    assert latch.read() is not None


def test_both_troubles_are_told_at_once(page, control, tmp_path):
    control.alive = False
    guard = Guard(page, FailingLatch(tmp_path), control, 0.001)
    reason = press(guard).reason
    assert "within 50 ms: USE THE HARDWARE STOP" in reason
    assert "not on disk" in reason


def test_a_press_is_answered_with_the_name_of_the_station(guard, control):
    assert press(guard).data == {"station": "bench-1"}


def test_what_a_control_said_before_it_died_does_not_count_for_a_new_press(guard, control):
    assert press(guard).status == "done"
    control.alive = False
    assert press(guard).status == "failed"


def test_a_release_clears_the_flag_and_the_disk(guard, page, latch):
    press(guard)
    page.ask_release()
    guard.watch()
    assert page.estop is EStop.CLEAR
    assert latch.read() is None


def test_nothing_is_released_that_was_not_asked_for(guard, page):
    press(guard)
    guard.watch()
    assert page.estop is EStop.LATCHED


def test_one_release_releases_one_press(guard, page):
    press(guard)
    page.ask_release()
    guard.watch()
    press(guard)
    guard.watch()
    assert page.estop is EStop.LATCHED


def test_a_release_asked_for_before_a_press_does_not_undo_that_press(guard, page, latch):
    press(guard)
    page.ask_release()
    press(guard)  # comes in before the guard has looked for releases
    guard.watch()
    assert page.estop is EStop.LATCHED
    assert latch.read() is not None


def test_a_latch_that_cannot_be_removed_stays_latched_and_the_guard_lives(page, control, tmp_path):
    latch = FailingLatch(tmp_path)
    guard = Guard(page, latch, control, PERIOD)
    press(guard)
    page.ask_release()
    guard.watch()
    assert page.estop is EStop.LATCHED
    latch.fails = False
    page.ask_release()
    guard.watch()
    assert page.estop is EStop.CLEAR


def test_a_restarted_guard_trusts_the_flag_where_the_disk_has_nothing(page, latch, control, tmp_path):
    press(Guard(page, FailingLatch(tmp_path), control, PERIOD))
    assert latch.read() is None
    Guard(page, latch, control, PERIOD)
    assert page.estop is EStop.LATCHED


def test_a_restarted_guard_does_not_carry_out_releases_of_before(page, latch, control):
    press(Guard(page, latch, control, PERIOD))
    page.ask_release()
    restarted = Guard(page, latch, control, PERIOD)
    restarted.watch()
    assert page.estop is EStop.LATCHED


def test_the_status_says_who_pressed(guard):
    assert guard.answer(Command("u", "status")).data == {"latched": False, "by": ""}
    press(guard)
    assert guard.answer(Command("u", "status")).data == {"latched": True, "by": "anna"}


@pytest.mark.parametrize("kind", ["release", "stop", ""])
def test_the_guard_knows_nothing_else(guard, page, kind):
    ack = guard.answer(Command("u", kind))
    assert (ack.status, ack.reason) == ("refused", f"the guard knows estop and status, not {kind!r}")
    assert page.estop is EStop.CLEAR
