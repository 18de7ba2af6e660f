"""What a page is sent, and what it is not while it does not answer."""

from __future__ import annotations

import json

import pytest

from evaweb.console import frame_parts
from evaweb.console.feed import History, LinkState
from evaweb.console.mailbox import CREDITS, EVENTS_AT_ONCE, Mailbox


class Page:
    """A page at a mailbox: what it was sent, and a flush as the room does it."""

    def __init__(self, *streams):
        self.sent = []
        self.box = Mailbox(self.sent.append)
        self.box.watch(streams, ())
        self.history = History()

    def flush(self):
        self.box.flush(self.history, lambda wanted: b"|".join(sorted(part.body for part in wanted)))

    def put(self, stream, body):
        self.box.put(part(stream, body))
        self.flush()

    @property
    def frames(self):
        return [message for message in self.sent if isinstance(message, bytes)]

    @property
    def texts(self):
        return [json.loads(message) for message in self.sent if isinstance(message, str)]

    @property
    def events(self):
        return [row["number"] for text in self.texts if text["type"] == "events" for row in text["events"]]


def part(stream, body):
    return frame_parts.EncodedPart(stream, (), body, 0.0)


def history(count, boot="b"):
    return History().extended(boot, [{"number": number} for number in range(1, count + 1)])


def test_two_frames_are_sent_without_an_answer_and_no_third():
    page = Page("joints")
    for number in range(10):
        page.put("joints", b"%d" % number)
    assert page.frames == [b"0", b"1"]


def test_after_a_credit_comes_the_newest_and_what_was_missed_never():
    page = Page("joints", "state")
    for number in range(10):
        page.put("joints", b"j%d" % number)
        page.put("state", b"s%d" % number)
    page.box.credit()
    page.flush()
    page.flush()
    assert page.frames[2:] == [b"j9|s9"]


def test_credits_do_not_add_up_beyond_two():
    page = Page("joints")
    for _ in range(9):
        page.box.credit()
    for number in range(9):
        page.put("joints", b"%d" % number)
    assert len(page.frames) == CREDITS


def test_only_what_is_watched_is_sent():
    page = Page("state")
    page.put("camera/a", b"picture")
    page.put("state", b"state")
    assert page.frames == [b"state"]


def test_who_comes_late_gets_the_last_of_each_at_once():
    page = Page()
    page.box.watch(["state", "camera/a"], [part("state", b"s"), part("joints", b"j"), part("camera/a", b"c")])
    page.flush()
    assert page.frames == [b"c|s"]


def test_a_page_that_never_reads_waits_for_one_part_of_each_stream():
    page = Page("camera/a", "camera/b")
    for number in range(1000):
        page.put("camera/a", b"a%d" % number)
        page.put("camera/b", b"b%d" % number)
    assert len(page.sent) == CREDITS
    assert {p.body for p in page.box._pending.values()} == {b"a999", b"b999"}


def test_events_come_in_order_without_gaps_once_they_are_asked_for():
    page = Page()
    page.history = history(3)
    page.flush()
    assert page.events == []
    page.box.want_events(1, "b")
    page.flush()
    page.history = history(5)
    page.flush()
    page.flush()
    assert page.events == [2, 3, 4, 5]


@pytest.mark.parametrize(("after", "boot"), [(2, "another"), (900, "b"), (0, "")])
def test_events_begin_anew_for_a_page_that_knows_another_boot(after, boot):
    page = Page()
    page.history = history(3)
    page.box.want_events(after, boot)
    page.flush()
    assert page.events == [1, 2, 3]


def test_a_restart_begins_the_events_anew():
    page = Page()
    page.history = history(3)
    page.box.want_events(0, "b")
    page.flush()
    page.history = history(2, "c")
    page.flush()
    assert page.events == [1, 2, 3, 1, 2]
    assert page.texts[-1]["boot"] == "c"


def test_redacted_events_come_once_each_with_the_parts_that_wait_beside_them():
    page = Page("joints")
    page.box.redacts_events = True
    page.box.want_events(0, "b")
    rows = []
    for number in range(1, 4):
        hidden = {"number": 2 * number - 1, "time": float(number), "kind": "policy_failed", "text": "secret"}
        rows += [hidden, hidden | {"number": 2 * number, "kind": "state", "text": "ready -> running"}]
        page.history = History().extended("b", rows)
        page.put("joints", b"%d" % number)
        page.box.credit()
    assert page.frames == [b"1", b"2", b"3"]
    assert page.events == [1_000_000, 2_000_000, 3_000_000]


def test_a_page_that_is_not_heard_gets_a_bounded_number_of_texts_and_then_the_rest():
    page = Page()
    page.box.want_events(0, "b")
    for number in range(1, 200):
        page.history = history(number)
        page.flush()
    held_back = len(page.texts)
    assert held_back < 50
    page.box.mark_read()
    page.flush()
    assert page.events == list(range(1, 200))
    assert len(page.texts) == held_back + 1


def test_many_events_come_in_messages_of_a_bearable_size():
    page = Page()
    page.history = history(2 * EVENTS_AT_ONCE + 1)
    page.box.want_events(0, "")
    page.flush()
    assert [len(text["events"]) for text in page.texts] == [EVENTS_AT_ONCE, EVENTS_AT_ONCE, 1]


def test_the_newest_word_on_the_link_and_all_changes_arrive():
    page = Page()
    page.box.put_link(LinkState(False, "away"))
    page.box.put_link(LinkState(True))
    page.box.put_changed(["trial"])
    page.box.put_changed(["lease", "trial"])
    page.flush()
    page.flush()
    assert page.texts == [
        {"type": "link", "ok": True, "reason": ""},
        {"type": "changed", "what": ["lease", "trial"]},
    ]
