"""Video encoders for recordings: presets, and options that make each write frames without delay.

A frame must reach the file at once and in the order of the rows: no B-frames, no look-ahead, closed groups.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal

CodecName = Literal["libx264", "libx265", "h264_nvenc"]
PIXELS = "yuv420p"
_X26 = ("ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow")
# x264's look-ahead would halve the size of still scenes, but delay each frame by as many periods; without force-cfr it
# delays one more frame to learn its duration. x265 without look-ahead delays none.
_X264_AT_ONCE = "scenecut=0:bframes=0:open-gop=0:rc-lookahead=0:mbtree=0:force-cfr=1"
_X265_AT_ONCE = (
    "scenecut=0:bframes=0:open-gop=0:rc-lookahead=0:cutree=0:frame-threads=1:pools=none:wpp=0:log-level=error"
)


@dataclass(frozen=True, slots=True)
class Codec:
    """Video encoder; `coded` is the format that it writes."""

    coded: str
    presets: tuple[str, ...]
    preset: str
    crf: int
    tag: str | None = None  # codec tag, if browsers need another one than the muxer's


CODECS: Mapping[str, Codec] = {
    "libx264": Codec("h264", _X26, "veryfast", 23),
    "libx265": Codec("hevc", _X26, "ultrafast", 28, "hvc1"),
    "h264_nvenc": Codec("h264", tuple(f"p{n}" for n in range(1, 8)), "p4", 23),
}


def options(name: str, preset: str, crf: int, gop: int) -> dict[str, str]:
    """Return the encoder's options."""
    chosen = {"preset": preset, "crf": str(crf), "forced-idr": "1"}
    if name == "libx264":
        return {**chosen, "x264-params": f"keyint={gop}:min-keyint=1:{_X264_AT_ONCE}"}
    if name == "libx265":
        return {**chosen, "x265-params": f"keyint={gop}:min-keyint=1:{_X265_AT_ONCE}"}
    return {
        "preset": preset,
        "rc": "vbr",
        "cq": str(crf),
        "forced-idr": "1",
        "tune": "ll",
        "delay": "0",
        "zerolatency": "1",
        "rc-lookahead": "0",
        "bf": "0",
    }


def configure_context(
    context: Any, name: str, size: tuple[int, int], rate: Fraction, told: Mapping[str, str], gop: int
) -> None:
    """Configure an encoder's context for pictures of `size` (height, width) at `rate` [Hz], with the options `told`."""
    context.height, context.width = size
    context.pix_fmt = PIXELS
    context.time_base = 1 / rate
    context.thread_count = 1
    context.gop_size = gop
    context.max_b_frames = 0
    context.options = dict(told)
    if (tag := CODECS[name].tag) is not None:
        context.codec_tag = tag
