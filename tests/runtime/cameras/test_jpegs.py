from __future__ import annotations

import io
from itertools import chain

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from runtime.cameras import jpegs
from runtime.cameras.jpegs import Jpegs


def coded(number: int, **how: object) -> bytes:
    pixels = np.random.default_rng(number).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    sink = io.BytesIO()
    Image.fromarray(pixels).save(sink, "JPEG", **how)
    return sink.getvalue()


def with_thumbnail() -> bytes:
    exif = Image.Exif()
    exif[0x927C] = coded(9)  # a whole picture within a segment
    return coded(1, exif=exif)


PICTURES = [coded(0), with_thumbnail(), coded(2, progressive=True), coded(3, restart_marker_blocks=2)]
BESIDE = [b"--eva\r\nContent-Type: image/jpg\r\n\r\n", b"\r\n", b"", b"\xff\xff\x00\xff", b"\xff\xd8"]


def found(pieces: list[bytes]) -> list[bytes]:
    finder = Jpegs()
    return list(chain.from_iterable(finder.add(piece) for piece in pieces))


@given(
    st.lists(st.tuples(st.sampled_from(BESIDE), st.sampled_from(PICTURES)), max_size=4),
    st.lists(st.integers(1, 700), min_size=1, max_size=5),
)
def test_pictures_are_found_whole_however_the_stream_comes_in_pieces(
    sent: list[tuple[bytes, bytes]], sizes: list[int]
) -> None:
    stream = b"".join(beside + picture for beside, picture in sent)
    pieces, at = [], 0
    while at < len(stream):
        size = sizes[len(pieces) % len(sizes)]
        pieces.append(stream[at : at + size])
        at += size
    assert found(pieces) == [picture for _, picture in sent]


def test_a_picture_is_there_with_its_last_byte() -> None:
    finder = Jpegs()
    assert list(finder.add(PICTURES[0][:-1])) == []
    assert list(finder.add(PICTURES[0][-1:])) == [PICTURES[0]]


@pytest.mark.parametrize("kept", [3, 200, 900])
def test_a_picture_that_is_cut_off_costs_no_later_one_but_its_neighbour(kept: int) -> None:
    stream = PICTURES[0][:kept] + b"\r\n--eva\r\n\r\n" + PICTURES[2] + b"\r\n" + PICTURES[3]
    assert found([stream])[-1] == PICTURES[3]


@given(st.binary(max_size=3000))
def test_any_bytes_are_passed_over(noise: bytes) -> None:
    stream = noise.replace(b"\xff", b"") + PICTURES[0]
    assert found([stream]) == [PICTURES[0]]


def test_what_is_held_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jpegs, "MOST_BYTES", 1 << 20)
    finder = Jpegs()
    for _ in range(100):
        assert list(finder.add(bytes(1 << 16))) == []  # no picture: nothing is held
    pieces = (PICTURES[0][:-2], *[bytes(1 << 16)] * 20)
    with pytest.raises(ValueError, match="has no end within 1 MiB"):
        list(chain.from_iterable(map(finder.add, pieces)))


def test_the_type_that_the_first_part_states_is_known() -> None:
    finder = Jpegs()
    list(finder.add(b"--eva\r\ncontent-type:  image/png\r\n"))
    assert (finder.stated, finder.is_single, finder.is_not_mjpeg) == ("image/png", False, False)
    list(finder.add(bytes(5000)))
    assert finder.is_not_mjpeg
