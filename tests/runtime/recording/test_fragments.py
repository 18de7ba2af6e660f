from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.recording.files import AppendFile
from runtime.recording.fragments import count_frames, whole_bytes
from runtime.recording.video import FragmentedVideo

from .samples import HEIGHT, SETTINGS, WIDTH, numbered, numbers

FRAMES = 50


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("video") / "a.mp4"
    file = AppendFile(path)
    video = FragmentedVideo(file, (HEIGHT, WIDTH), 30.0, SETTINGS)
    for k in range(FRAMES):
        video.encode(numbered(k))
    video.close()
    file.close()
    return path.read_bytes()


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cut") / "a.mp4"


def test_a_whole_video_is_whole(video: bytes, path: Path) -> None:
    path.write_bytes(video)
    assert whole_bytes(path) == len(video)
    assert count_frames(path) == FRAMES


@given(data=st.data())
def test_a_cut_at_any_byte_leaves_the_frames_of_the_whole_fragments(
    video: bytes, path: Path, data: st.DataObject
) -> None:
    cut = data.draw(st.integers(0, len(video)))
    path.write_bytes(video[:cut])
    end = whole_bytes(path)
    assert end <= cut
    assert 0 <= count_frames(path) <= FRAMES
    path.write_bytes(video[:end])
    assert whole_bytes(path) == end
    frames = count_frames(path)
    if frames:
        assert numbers(path) == list(range(frames))


@given(data=st.data())
def test_zeros_in_the_place_of_the_tail_are_no_fragments(
    video: bytes, path: Path, data: st.DataObject
) -> None:
    cut = data.draw(st.integers(0, len(video) - 1))
    path.write_bytes(video[:cut] + bytes(len(video) - cut))
    assert 0 <= count_frames(path) <= FRAMES
    assert whole_bytes(path) <= len(video)


@pytest.mark.parametrize("content", [b"", b"\0" * 100, b"no video at all, just words", b"\0\0\0\1mdat\0\0"])
def test_something_else_has_no_frames(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    assert whole_bytes(path) == 0
    assert count_frames(path) == 0
