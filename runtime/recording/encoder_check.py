"""Check of a deployment's video encoder on this machine, by coding a few pictures."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import av
import numpy as np
from av.video.frame import PictureType

from runtime.core.errors import ConfigurationError
from runtime.recording.codecs import CODECS, PIXELS, configure_context, options
from runtime.recording.settings import RecordingSettings

_SIZE = (192, 256)  # height and width; hardware encoders refuse smaller pictures
_PICTURES = 4


def require_encoder(settings: RecordingSettings) -> None:
    """Raise ConfigurationError, with the usable encoders, if this machine cannot encode with these settings."""
    name = settings.codec
    try:
        _code(name, settings.chosen_preset, settings.chosen_crf, settings.gop or 1)
    except (av.FFmpegError, ValueError) as error:
        usable = ", ".join(codec for codec in CODECS if codec != name and is_encoder_usable(codec))
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigurationError(
            f"recording.codec = {name!r} does not work on this machine: {reason}; allowed here: {usable or 'none'}"
        ) from error


def is_encoder_usable(name: str) -> bool:
    """Return True if this machine can use that encoder with its default settings."""
    codec = CODECS[name]
    try:
        _code(name, codec.preset, codec.crf, 1)
    except (av.FFmpegError, ValueError):
        return False
    return True


def _code(name: str, preset: str, crf: int, gop: int) -> None:
    rate = Fraction(30)
    context: Any = av.CodecContext.create(name, "w")
    context.framerate = rate
    configure_context(context, name, _SIZE, rate, options(name, preset, crf, gop), gop)
    coded = 0
    for number in range(_PICTURES):
        frame = av.VideoFrame.from_ndarray(np.full((*_SIZE, 3), 40 * number, np.uint8), format="rgb24")
        frame = frame.reformat(format=PIXELS)
        frame.pts, frame.time_base, frame.pict_type = number, 1 / rate, PictureType.NONE
        coded += len(context.encode(frame))
    coded += len(context.encode(None))
    if coded != _PICTURES:
        raise ValueError(f"it made {coded} frames of {_PICTURES}")
