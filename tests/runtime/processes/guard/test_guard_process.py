import errno
import mmap
import os

import pytest
import zmq

from runtime.core.clock import VirtualClock
from runtime.ipc.bus import Endpoints, Key
from runtime.ipc.endpoints import account_name
from runtime.ipc.estop_latch import Latch
from runtime.ipc.messages import Command, decode, encode
from runtime.ipc.shared_state import EStop, SharedState, SharedStateLayout
from runtime.processes.guard import process as guard_module
from runtime.processes.guard.process import EStopServer, Guard
from tests import presses
from tests.processes import PATIENCE_MS

LAYOUT = SharedStateLayout(dim=2, eef_dim=8, cameras=())
PERIOD = 1 / 30


class Control:
    """A clock on whose every wait control ticks, and obeys the flag where it is alive."""

    def __init__(self, shared):
        self.shared, self.alive, self.slept = shared, True, 0.0
        self.clock = VirtualClock(100.0)
        self.now = self.clock.now

    def sleep_until(self, deadline):
        self.clock.sleep_until(deadline)
        if self.alive:
            self.tick()

    def tick(self):
        status = self.shared.control.read().copy()
        status["estop_obeyed"] = self.shared.estop is EStop.LATCHED
        self.shared.control.write(status)


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
def shared():
    return SharedState(LAYOUT, mmap.mmap(-1, SharedState.size(LAYOUT)))


@pytest.fixture
def latch(tmp_path):
    tmp_path.joinpath("bench-1").mkdir()
    return Latch(tmp_path / "bench-1")


@pytest.fixture
def control(shared):
    return Control(shared)


@pytest.fixture
def guard(shared, latch, control):
    return Guard(shared, latch, control, PERIOD, "bench-1")


def press(guard, **changes):
    return guard.answer(Command("u", "estop", {"why": "arm too low"}, **({"user": "anna"} | changes)))


def test_a_guard_that_finds_no_latch_lets_commands_pass(guard, shared):
    assert shared.estop is EStop.CLEAR


def test_a_station_latched_before_its_start_starts_latched(shared, latch, control):
    latch.set("anna", "yesterday")
    Guard(shared, latch, control, PERIOD)
    assert shared.estop is EStop.LATCHED


def test_a_latch_that_cannot_be_read_starts_latched(shared, latch, control, tmp_path):
    (tmp_path / "bench-1" / "estop.json").write_text("{", "utf-8")
    Guard(shared, latch, control, PERIOD)
    assert shared.estop is EStop.LATCHED


def test_a_press_raises_the_flag_and_is_on_disk(guard, shared, latch):
    ack = press(guard)
    assert (ack.uuid, ack.status) == ("u", "done")
    assert ack.reason == "every tick now sends the measured position"
    assert shared.estop is EStop.LATCHED
    assert (latch.read().by, latch.read().why) == ("anna", "arm too low")


@pytest.mark.parametrize(
    ("changes", "by"),
    [({}, "anna"), ({"user": "", "holder": "page-7"}, "page-7"), ({"user": "", "holder": ""}, "unknown")],
)
def test_anybody_may_press_and_is_named_as_far_as_known(guard, latch, changes, by):
    assert press(guard, **changes).status == "done"
    assert latch.read().by == by


def test_the_flag_is_raised_before_the_disk_is_touched(shared, control, latch, monkeypatch):
    seen = []
    guard = Guard(shared, latch, control, PERIOD)
    monkeypatch.setattr(latch, "set", lambda *_: seen.append(shared.estop))
    press(guard)
    assert seen == [EStop.LATCHED]


def test_nothing_is_logged_before_the_flag_the_disk_and_the_answer(guard, shared, latch, caplog):
    ack = press(guard)
    assert (ack.status, caplog.text) == ("done", "")
    guard.poll()
    assert "E-STOP by anna: arm too low" in caplog.text
    caplog.clear()
    guard.poll()
    assert caplog.text == ""


def test_a_disk_that_fails_does_not_keep_the_flag_down(shared, control, tmp_path):
    guard = Guard(shared, FailingLatch(tmp_path), control, PERIOD)
    ack = press(guard)
    assert shared.estop is EStop.LATCHED
    assert ack.status == "done"
    assert ack.reason.endswith(
        "not on disk (No space left on device): a restart of the station may forget it"
    )


def test_a_control_that_does_not_answer_means_the_hardware_stop(guard, shared, control, latch):
    control.alive = False
    begun = control.now()
    ack = press(guard)
    assert ack.status == "failed"
    assert ack.reason == "latched, but control has not obeyed within 67 ms: USE THE HARDWARE STOP"
    assert control.now() - begun == pytest.approx(2 * PERIOD, abs=0.003)
    assert shared.estop is EStop.LATCHED
    assert latch.read() is not None


def test_both_troubles_are_told_at_once(shared, control, tmp_path):
    control.alive = False
    guard = Guard(shared, FailingLatch(tmp_path), control, 0.001)
    reason = press(guard).reason
    assert "within 50 ms: USE THE HARDWARE STOP" in reason
    assert "not on disk" in reason


def test_a_press_is_answered_with_the_name_of_the_station(guard, control):
    assert press(guard).data == {"station": "bench-1"}


def test_what_a_control_said_before_it_died_does_not_count_for_a_new_press(guard, control):
    assert press(guard).status == "done"
    control.alive = False
    assert press(guard).status == "failed"


def test_a_release_clears_the_flag_and_the_disk(guard, shared, latch):
    press(guard)
    shared.request_release()
    guard.poll()
    assert shared.estop is EStop.CLEAR
    assert latch.read() is None


def test_nothing_is_released_that_was_not_asked_for(guard, shared):
    press(guard)
    guard.poll()
    assert shared.estop is EStop.LATCHED


def test_one_release_releases_one_press(guard, shared):
    press(guard)
    shared.request_release()
    guard.poll()
    press(guard)
    guard.poll()
    assert shared.estop is EStop.LATCHED


def test_a_release_asked_for_before_a_press_does_not_undo_that_press(guard, shared, latch):
    press(guard)
    shared.request_release()
    press(guard)  # comes in before the guard has looked for releases
    guard.poll()
    assert shared.estop is EStop.LATCHED
    assert latch.read() is not None


def test_a_latch_that_cannot_be_removed_stays_latched_and_the_guard_lives(shared, control, tmp_path):
    latch = FailingLatch(tmp_path)
    guard = Guard(shared, latch, control, PERIOD)
    press(guard)
    shared.request_release()
    guard.poll()
    assert shared.estop is EStop.LATCHED
    latch.fails = False
    shared.request_release()
    guard.poll()
    assert shared.estop is EStop.CLEAR


def test_a_restarted_guard_trusts_the_flag_where_the_disk_has_nothing(shared, latch, control, tmp_path):
    press(Guard(shared, FailingLatch(tmp_path), control, PERIOD))
    assert latch.read() is None
    Guard(shared, latch, control, PERIOD)
    assert shared.estop is EStop.LATCHED


def test_a_restarted_guard_does_not_carry_out_releases_of_before(shared, latch, control):
    press(Guard(shared, latch, control, PERIOD))
    shared.request_release()
    restarted = Guard(shared, latch, control, PERIOD)
    restarted.poll()
    assert shared.estop is EStop.LATCHED


def to_main(shared, uuid="u"):
    """What the coordinator does with a press that comes to its socket."""
    shared.rings["presses"].push(encode(Command(uuid, "estop", {"why": "at the wrong door"}, "ben")))
    shared.set_estop(EStop.LATCHED)


def test_a_press_that_came_to_main_is_latched_on_disk_with_who_and_why(guard, shared, latch):
    to_main(shared)
    guard.poll()
    assert (latch.read().by, latch.read().why) == ("ben", "at the wrong door")
    assert shared.estop is EStop.LATCHED


def test_a_press_that_came_to_main_while_there_was_no_guard_is_latched_by_the_next(shared, latch, control):
    to_main(shared)
    restarted = Guard(shared, latch, control, PERIOD)
    restarted.poll()
    assert (shared.estop, latch.read().by) == (EStop.LATCHED, "ben")


def test_a_release_under_way_does_not_undo_a_press_that_comes_to_main(guard, shared, latch):
    press(guard)
    shared.request_release()
    to_main(shared)
    guard.poll()
    assert (shared.estop, latch.read().by) == (EStop.LATCHED, "ben")


def test_the_status_says_who_pressed(guard):
    assert guard.answer(Command("u", "status")).data == {"latched": False, "by": ""}
    press(guard)
    assert guard.answer(Command("u", "status")).data == {"latched": True, "by": "anna"}


@pytest.mark.parametrize("kind", ["release", "stop", ""])
def test_the_guard_knows_nothing_else(guard, shared, kind):
    ack = guard.answer(Command("u", kind))
    assert (ack.status, ack.reason) == ("refused", f"the guard knows estop and status, not {kind!r}")
    assert shared.estop is EStop.CLEAR


# --- the socket ----------------------------------------------------------------------------------------------


class Counting(Latch):
    """A latch that counts how often it is written."""

    def __init__(self, folder):
        super().__init__(folder)
        self.written = 0

    def set(self, by, why):
        self.written += 1
        return super().set(by, why)


class Door:
    """The guard behind its real socket; `client` sends whatever it likes."""

    def __init__(self, shared, control, folder):
        self.folder, self.shared, self.latch = folder, shared, Counting(folder)
        self.context = zmq.Context()
        self.guard = Guard(shared, self.latch, control, PERIOD, "bench-1")
        self.desk = EStopServer(self.guard, shared, self.context, folder)
        self._endpoint = Endpoints(folder).read("guard")["estop"]

    def client(self):
        made = self.context.socket(zmq.DEALER)
        made.set_hwm(100_000)
        made.linger = 0
        made.connect(self._endpoint)
        return made

    def serve(self, turns=1):
        for _ in range(turns):
            self.desk.serve(2.0)
            self.guard.poll()

    def heard(self, client):
        """What the client is answered first, however many turns what others send takes."""
        for _ in range(200):
            self.serve()
            if client.poll(10):
                return decode(client.recv())
        raise AssertionError("no answer")

    def close(self):
        self.desk.close()
        self.context.destroy(linger=0)


@pytest.fixture
def door(shared, control, tmp_path):
    made = Door(shared, control, tmp_path / "bench-1")
    yield made
    made.close()


def pressed(uuid="u", user="anna", why="smoke"):
    return encode(Command(uuid, "estop", {"why": why}, user, user))


def answers(client):
    found = []
    while client.poll(200):
        found.append(decode(client.recv()))
    return found


def test_a_press_that_the_web_has_signed_is_recorded_by_name(door):
    payload = pressed()
    client = door.client()
    client.send_multipart([payload, Key(door.folder).sign(payload)])
    door.serve()
    assert [(ack.uuid, ack.status) for ack in answers(client)] == [("u", "done")]
    assert door.latch.read().by == "anna"


def test_a_press_of_a_program_is_recorded_by_account(door):
    client = door.client()
    client.send(pressed())
    door.serve()
    assert answers(client)[0].status == "done"
    assert door.latch.read().by == f"account:{account_name(os.geteuid())}"


@pytest.mark.parametrize("trouble", ["forged", "no key", "a key for everybody", "a folder for a key"])
def test_a_press_that_cannot_be_verified_is_obeyed_and_recorded_so(door, shared, trouble):
    payload = pressed()
    signature = b"made up" if trouble == "forged" else Key(door.folder).sign(payload)
    if trouble == "no key":
        (door.folder / "bus.key").unlink()
    elif trouble == "a key for everybody":
        (door.folder / "bus.key").chmod(0o644)
    elif trouble == "a folder for a key":
        (door.folder / "bus.key").unlink()
        (door.folder / "bus.key").mkdir()
    client = door.client()
    client.send_multipart([payload, signature])
    door.serve()
    assert answers(client)[0].status == "done"
    assert shared.estop is EStop.LATCHED
    assert door.latch.read().by == "anna (unverified)"


@pytest.mark.parametrize("name", presses.PACKED)
def test_whatever_is_wrong_with_a_press_it_is_pressed_recorded_and_answered(door, shared, name):
    client = door.client()
    client.send(presses.PACKED[name])
    door.serve()
    (ack,) = answers(client)
    assert (ack.status, shared.estop) == ("done", EStop.LATCHED)
    assert door.latch.read().by == f"account:{account_name(os.geteuid())}"
    assert 0 < len(door.latch.read().why) < 1000


_WHOLE = pressed()


@pytest.mark.parametrize(
    "frames",
    [
        [b"x", _WHOLE],
        [b"", b"x", _WHOLE],
        [b"x", b"y", _WHOLE],
        *([_WHOLE[:end], _WHOLE[end:]] for end in (3, _WHOLE.index(b"estop") + 2, len(_WHOLE) - 1)),
        [_WHOLE[number : number + 7] for number in range(0, len(_WHOLE), 7)],
    ],
)
def test_a_press_in_a_later_frame_or_in_several_is_heard(door, shared, frames):
    client = door.client()
    client.send_multipart(frames)
    door.serve()
    assert client.poll(PATIENCE_MS)
    assert decode(client.recv_multipart()[-1]).status == "done"
    assert shared.estop is EStop.LATCHED


@pytest.mark.parametrize("name", presses.OTHERS)
def test_what_follows_a_message_of_another_kind_makes_it_no_press(door, shared, name):
    client = door.client()
    client.send_multipart([presses.OTHERS[name], b"a signature with kind: estop"])
    door.serve()
    assert shared.estop is EStop.CLEAR


@pytest.mark.parametrize("name", presses.OTHERS)
def test_what_only_speaks_of_the_e_stop_does_not_press_it(door, shared, name):
    client = door.client()
    client.send(presses.OTHERS[name])
    door.serve()
    assert len(answers(client)) == 1
    assert shared.estop is EStop.CLEAR


def test_presses_behind_a_flood_of_long_garbage_are_answered_before_it_is_read(door, shared):
    noisy, client = door.client(), door.client()
    for _ in range(200):
        noisy.send(b"\xc1" * (200 << 10))
    client.send(pressed("mine", "ben"))
    assert door.heard(client).uuid == "mine"
    assert shared.estop is EStop.LATCHED


def test_the_flag_is_up_before_anybody_is_asked_who_he_is(door, shared, monkeypatch):
    seen = []
    monkeypatch.setattr(
        guard_module, "authenticate", lambda command, *_: seen.append(shared.estop) or command
    )
    client = door.client()
    client.send(pressed())
    door.serve()
    assert seen == [EStop.LATCHED]


def test_the_answer_says_whether_the_press_latched_and_when_it_was_carried_out(door, shared):
    client = door.client()

    def asked(uuid):
        client.send(pressed(uuid))
        said = door.heard(client).data
        return said["latched"], said["carried_out_at"]

    first, again, other = asked("u"), asked("u"), asked("v")
    assert [latched for latched, _ in (first, again, other)] == ["anew", "before", "already"]
    assert again[1] == first[1] < other[1]
    shared.request_release()
    door.guard.poll()
    late = asked("u")
    assert late[0] == "anew"
    assert late[1] > other[1]


def test_of_presses_that_come_together_the_first_latched(door):
    client = door.client()
    for uuid in ("u", "v", "u"):
        client.send(pressed(uuid))
    found = [door.heard(client).data for _ in range(3)]
    assert [said["latched"] for said in found] == ["anew", "already", "before"]
    assert found[0]["carried_out_at"] == found[2]["carried_out_at"]


@pytest.mark.parametrize("same", [True, False], ids=["one uuid", "1500 uuids"])
def test_a_flood_of_presses_is_latched_once_and_every_one_is_answered(door, same):
    client = door.client()
    for number in range(1500):
        client.send(pressed("u" if same else str(number)))
    found = []
    for _ in range(20):
        door.serve()
        found += answers(client)
        if len(found) >= 1500:
            break
    assert {ack.status for ack in found} == {"done"}
    assert [ack.uuid for ack in found] == ["u" if same else str(number) for number in range(1500)]
    assert door.latch.written == 1


@pytest.mark.parametrize("flood", [pressed(), b"\xc1 no message", encode(Command("s", "status"))])
def test_a_flood_does_not_delay_the_press_of_another(door, flood):
    noisy, client = door.client(), door.client()
    for _ in range(1500):
        noisy.send(flood)
    client.send(pressed("mine", "ben"))
    ack = door.heard(client)
    assert (ack.uuid, ack.status) == ("mine", "done")


def test_different_reasons_in_a_flood_are_one_latch_in_a_turn(door):
    client = door.client()
    for number in range(500):
        client.send(pressed(str(number), why=f"reason {number}"))
    found, turns = [], 0
    while len(found) < 500 and turns < 20:
        door.serve()
        turns += 1
        found += answers(client)
    assert (len(found), door.latch.written <= turns) == (500, True)


def test_a_repeat_after_a_release_presses_again(door, shared):
    client = door.client()
    client.send(pressed())
    door.serve()
    shared.request_release()
    door.guard.poll()
    assert (shared.estop, door.latch.read()) == (EStop.CLEAR, None)
    client.send(pressed())
    door.serve()
    assert [ack.status for ack in answers(client)] == ["done", "done"]
    assert shared.estop is EStop.LATCHED
    assert door.latch.read() is not None


def test_a_press_that_control_did_not_obey_is_asked_for_anew_when_it_is_repeated(door, control):
    control.alive = False
    client = door.client()
    client.send(pressed())
    door.serve()
    control.alive = True
    client.send(pressed())
    door.serve()
    assert [ack.status for ack in answers(client)] == ["failed", "done"]
