"""What a lab does with what a station sends of its episodes: honest, cut off at any byte, or hostile."""

import hashlib
import json
import os
from dataclasses import replace

import pytest

from runtime.link import incoming
from runtime.link.contents import Contents, File, contents_of, unpacked
from runtime.link.incoming import Shelf, arrivals, progress_of
from runtime.link.wire import PIECE, Arrived, Declined, Labels, Offer, Piece, Want
from runtime.recording.archive_index import write_index
from tests.runtime.link.episodes import content, recorded, uuid_of

STATION = "bench-7"
UUID = uuid_of(1)


@pytest.fixture
def home(tmp_path):
    return recorded(tmp_path / "robot", STATION)


@pytest.fixture
def data(tmp_path):
    (tmp_path / "lab" / "episodes").mkdir(parents=True)
    return tmp_path / "lab"


@pytest.fixture
def shelf(data):
    return Shelf(data, STATION, lambda uuid: "", reserve=0)


def offered(shelf, folder, episode=UUID):
    return list(shelf.handle(Offer(episode), contents_of(folder).packed()))


def sent(shelf, folder, said, pieces=10**6):
    """Answer what the lab wants, as an honest station does, with so many pieces; what it says at last."""
    wanted = list(said)
    while wanted and pieces and isinstance(wanted[0], Want):
        want, pieces = wanted.pop(0), pieces - 1
        with (folder / want.file).open("rb") as file:
            file.seek(want.offset)
            wanted += shelf.handle(Piece(want.episode, want.file, want.offset), file.read(want.count))
    return wanted


def why(said):
    (declined,) = said
    assert isinstance(declined, Declined)
    return declined.why


def test_an_episode_is_there_at_once_when_all_of_it_is_and_the_worker_hears_of_it(shelf, home, data):
    said = sent(shelf, home, offered(shelf, home), pieces=3)
    assert not (data / "episodes" / UUID).exists()
    assert arrivals(data) == []
    assert sent(shelf, home, said) == [Arrived(UUID, contents_of(home).digest)]
    assert content(data / "episodes" / UUID) == content(home)
    assert [uuid for uuid, _ in arrivals(data)] == [UUID]
    assert progress_of(data, STATION, UUID) is None
    assert list((data / "episodes" / ".arriving" / STATION).iterdir()) == []


def test_what_is_here_is_told_while_it_comes(shelf, home, data):
    sent(shelf, home, offered(shelf, home), pieces=2)
    size = contents_of(home).size
    assert progress_of(data, STATION, UUID) == incoming.Progress(900 + PIECE, size)


@pytest.mark.parametrize("here", [0, 1, 899, PIECE - 1, PIECE, PIECE + 1, 199_999, 200_000])
def test_it_goes_on_from_whichever_byte_the_last_try_ended_at(data, shelf, home, here):
    offered(shelf, home)
    shelf.drop()
    partly = data / "episodes" / ".arriving" / STATION / UUID / "front.mp4"
    partly.write_bytes((home / "front.mp4").read_bytes()[:here])
    again = Shelf(data, STATION, lambda uuid: "", reserve=0)
    asked, said = [], offered(again, home)
    while isinstance(said[0], Want):
        asked += [want for want in said[:1] if want.file == "front.mp4"]
        said = said[1:] + sent(again, home, said[:1], pieces=1)
    assert sum(want.count for want in asked) == 200_000 - here
    assert said == [Arrived(UUID, contents_of(home).digest)]
    assert content(data / "episodes" / UUID) == content(home)


@pytest.mark.parametrize("damage", [b"", b"x" * 70_000, b"y" * 70_001], ids=["lost", "changed", "longer"])
def test_what_a_power_cut_left_is_found_by_its_digest_and_sent_anew(data, shelf, home, damage):
    offered(shelf, home)
    shelf.drop()
    (data / "episodes" / ".arriving" / STATION / UUID / "ticks.arrow").write_bytes(damage)
    again = Shelf(data, STATION, lambda uuid: "", reserve=0)
    assert isinstance(sent(again, home, offered(again, home))[0], Arrived)
    assert content(data / "episodes" / UUID) == content(home)


def test_one_that_is_here_is_compared_and_acknowledged_again(data, shelf, home):
    sent(shelf, home, offered(shelf, home))
    assert offered(shelf, home) == [Arrived(UUID, contents_of(home).digest)]


@pytest.mark.parametrize("where", ["station", "lab"])
def test_one_that_is_here_with_other_content_is_refused_by_name_and_stays(data, shelf, home, where):
    sent(shelf, home, offered(shelf, home))
    changed = (home if where == "station" else data / "episodes" / UUID) / "front.mp4"
    changed.write_bytes(b"another")
    before = content(data / "episodes" / UUID)
    assert "already, with other content (front.mp4): nothing is overwritten" in why(offered(shelf, home))
    assert content(data / "episodes" / UUID) == before


def test_one_whose_videos_the_lab_has_in_its_store_has_arrived_if_the_store_gives_them(data, home):
    lost = []

    def read_back(digest):
        if digest in lost:
            raise OSError("it is lost")

    shelf = Shelf(data, STATION, lambda uuid: "", reserve=0, read_back=read_back)
    sent(shelf, home, offered(shelf, home))
    video = data / "episodes" / UUID / "front.mp4"
    digest = hashlib.sha256(video.read_bytes()).hexdigest()
    video.unlink()
    write_index(data, UUID, {"front.mp4": digest})
    (answer,) = offered(shelf, home)
    assert isinstance(answer, Arrived)
    lost.append(digest)
    assert why(offered(shelf, home)) == "front.mp4 is in the lab's store, which does not give it: it is lost"
    assert "does not read the store" in why(offered(Shelf(data, STATION, lambda uuid: "", reserve=0), home))
    write_index(data, UUID, {"front.mp4": "0" * 64})
    assert "with other content (front.mp4)" in why(offered(shelf, home))


def test_one_that_appears_meanwhile_is_not_overwritten(data, shelf, home):
    said = sent(shelf, home, offered(shelf, home), pieces=3)
    recorded(data, "bench-1", seed=2, uuid=UUID)
    before = content(data / "episodes" / UUID)
    assert "with other content" in why(sent(shelf, home, said))
    assert content(data / "episodes" / UUID) == before


def test_an_episode_that_changed_at_home_before_it_was_all_here_begins_anew(data, shelf, home):
    sent(shelf, home, offered(shelf, home), pieces=3)
    (home / "events.jsonl").write_bytes(b"repaired")
    assert isinstance(sent(shelf, home, offered(shelf, home))[0], Arrived)
    assert content(data / "episodes" / UUID) == content(home)


def test_another_stations_episode_is_refused(data, home):
    shelf = Shelf(data, STATION, lambda uuid: "bench-1", reserve=0)
    assert "of another station of this lab" in why(offered(shelf, home))


def test_a_database_that_does_not_say_whose_it_is_is_asked_again_later(data, home):
    def away(uuid):
        raise OSError("the database is away")

    (declined,) = offered(Shelf(data, STATION, away, reserve=0), home)
    assert (declined.again_s, "cannot say now" in declined.why) == (60.0, True)


@pytest.mark.parametrize("lie", [{"station": "bench-1"}, {"uuid": uuid_of(9)}, {"station": None}])
def test_a_manifest_that_is_of_another_station_or_episode_is_thrown_away(data, shelf, home, lie):
    told = json.loads((home / "manifest.json").read_text()) | lie
    (home / "manifest.json").write_text(json.dumps(told))
    assert "does not say that it is this station's" in why(sent(shelf, home, offered(shelf, home)))
    assert not (data / "episodes" / UUID).exists()
    assert not (data / "episodes" / ".arriving" / STATION / UUID).exists()


@pytest.mark.parametrize(
    "episode", ["../x", "", ".arriving", UUID.upper(), UUID.replace("-", ""), "a" * 4000]
)
def test_a_name_that_is_no_uuid_is_refused_and_leads_nowhere(data, shelf, home, episode):
    assert "is no episode" in why(offered(shelf, home, episode))
    assert sorted(path.name for path in data.rglob("*")) == ["episodes"]


BAD = ["../a", "a/b", ".hidden", "", "/etc/passwd", "a\0b", "\ud800", "x" * 256, 7, None]


@pytest.mark.parametrize("name", BAD)
def test_a_file_that_is_named_like_a_path_is_refused(data, shelf, home, name):
    rows = [*json.loads(contents_of(home).packed()), [name, 1, "00" * 32]]
    assert "cannot name a file" in why(list(shelf.handle(Offer(UUID), json.dumps(rows).encode())))
    assert not (data / "episodes" / ".arriving" / STATION / UUID).exists()


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (b"", "is none of 1 to 256 files"),
        (b"[]", "is none of 1 to 256 files"),
        (b"[" * 100_000, "is none of 1 to 256 files"),
        (b"{}", "is none of 1 to 256 files"),
        (b" " * (1 << 20) + b"[1]", "is none of 1 to 256 files"),
        (json.dumps([["a", 1, "00" * 32]] * 257).encode(), "is none of 1 to 256 files"),
        (json.dumps([["a", 1, "00" * 32]] * 2).encode(), "in the list twice"),
        (json.dumps([["a", 1, "00" * 32]]).encode(), "is not in the list"),
        (json.dumps([["a", -1, "00" * 32]]).encode(), "a has -1 bytes"),
        (json.dumps([["a", True, "00" * 32]]).encode(), "a has True bytes"),
        (json.dumps([["a", 1 << 41, "00" * 32]]).encode(), "bytes; allowed"),
        (json.dumps([["a", 1, "zz" * 32]]).encode(), "expected 64 hexadecimal"),
        (json.dumps([["a", 1]]).encode(), "is no file of a list"),
    ],
)
def test_a_list_that_is_none_is_refused_with_a_sentence(shelf, rows, said):
    assert said in why(list(shelf.handle(Offer(UUID), rows)))


def test_bytes_that_are_not_what_the_list_says_are_sent_three_times_and_no_more(data, shelf, home):
    said = offered(shelf, home)
    for _ in range(3):
        want = said[0]
        assert (want.file, want.offset) == ("events.jsonl", 0)
        said = list(shelf.handle(Piece(UUID, want.file, 0), bytes(want.count)))
    assert "was sent 3 times, and is not what its SHA-256 says" in why(said)
    assert not (data / "episodes" / UUID).exists()


@pytest.mark.parametrize(
    ("lie", "said"),
    [
        (lambda want, data: (want, data + b"x"), "and has 901 now"),
        (lambda want, data: (want, b""), "and has 0 now"),
        (lambda want, data: (replace(want, offset=1), data), "not what was asked for"),
        (lambda want, data: (replace(want, file="../x"), data), "not what was asked for"),
    ],
    ids=["longer", "gone", "elsewhere", "path"],
)
def test_a_piece_that_was_not_asked_for_ends_the_try_and_writes_nothing(data, shelf, home, lie, said):
    want, piece = lie(offered(shelf, home)[0], (home / "events.jsonl").read_bytes())
    assert said in why(list(shelf.handle(Piece(want.episode, want.file, want.offset), piece)))
    assert (data / "episodes" / ".arriving" / STATION / UUID / "events.jsonl").read_bytes() == b""
    assert list(shelf.handle(Piece(UUID, "events.jsonl", 0), b"more")) == []  # of a try that has ended


def test_an_episode_for_which_there_is_no_room_is_declined_before_a_byte_of_it_comes(data, home):
    free = os.statvfs(data).f_bavail * os.statvfs(data).f_frsize
    shelf = Shelf(data, STATION, lambda uuid: "", reserve=2 * free)
    (declined,) = offered(shelf, home)
    assert "too little room" in declined.why
    assert declined.again_s == 60.0
    assert "too little room" in progress_of(data, STATION, UUID).why


def test_a_size_that_no_disk_has_is_declined(shelf, home):
    files = (*contents_of(home).files, File("huge.mp4", 1 << 39, "00" * 32))
    assert "too little room" in why(list(shelf.handle(Offer(UUID), Contents(files).packed())))


def test_a_disk_that_fills_up_ends_the_try_with_a_sentence_and_keeps_what_is_here(
    data, shelf, home, monkeypatch
):
    said = sent(shelf, home, offered(shelf, home), pieces=3)

    def full(descriptor, view, offset):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(incoming.os, "pwrite", full)
    assert "disk full" in why(sent(shelf, home, said)[:1])
    monkeypatch.undo()
    assert progress_of(data, STATION, UUID).here >= PIECE
    assert isinstance(sent(shelf, home, offered(shelf, home))[0], Arrived)


def test_of_many_that_were_begun_the_last_three_stay(tmp_path, data, shelf):
    for seed in range(6):
        folder = recorded(tmp_path / "robot", STATION, seed)
        sent(shelf, folder, offered(shelf, folder, folder.name), pieces=2)
        os.utime(data / "episodes" / ".arriving" / STATION / folder.name, (seed, seed))
    begun = [path.name for path in (data / "episodes" / ".arriving" / STATION).iterdir() if path.is_dir()]
    assert sorted(begun) == sorted(uuid_of(seed) for seed in (3, 4, 5))


def test_a_link_in_place_of_a_file_is_not_followed(tmp_path, data, shelf, home):
    target = tmp_path / "target"
    target.write_bytes(b"")
    offered(shelf, home)
    shelf.drop()
    (data / "episodes" / ".arriving" / STATION / UUID / "front.mp4").symlink_to(target)
    assert isinstance(sent(shelf, home, offered(shelf, home))[0], Arrived)
    assert target.read_bytes() == b""


def test_labels_grow_and_are_never_replaced(data, shelf, home):
    sent(shelf, home, offered(shelf, home))
    (arrived,) = shelf.handle(Labels(UUID), b"one\n")
    assert isinstance(arrived, Arrived)
    assert isinstance(next(shelf.handle(Labels(UUID), b"one\ntwo\n")), Arrived)
    assert "nothing is overwritten" in why(list(shelf.handle(Labels(UUID), b"two\n")))
    assert (data / "labels" / f"{UUID}.jsonl").read_bytes() == b"one\ntwo\n"


def test_labels_of_another_stations_episode_are_refused(data, shelf):
    recorded(data, "bench-1")
    assert "of another station" in why(list(shelf.handle(Labels(UUID), b"one\n")))
    assert not (data / "labels").exists()


def test_a_list_comes_back_as_it_was_written(home):
    assert unpacked(contents_of(home).packed()) == contents_of(home)
