"""Content of messages: joints by name, pictures by encoding. Implausible messages are refused."""

from __future__ import annotations

from typing import Literal

import numpy as np

from runtime.core.errors import CodecError
from runtime.core.picture_bounds import MOST_PIXELS, require_scans
from runtime.core.types import Float32, Float64, UInt8
from runtime.transports.ros.messages import CompressedImage, Image, JointState, PoseStamped
from runtime.transports.ros.topics import StreamSpec

Names = Literal["check", "ignore"]
_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1, "rgba8": 4, "bgra8": 4}
_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"


class UnusableMessage(CodecError):
    """Message that cannot be used; `fault` is the name under which it is counted."""

    def __init__(self, fault: str, text: str) -> None:
        super().__init__(text)
        self.fault = fault


class JointOrder:
    """Order of the values in a stream's messages; `read` returns them in the order of `part.joints`.

    Messages with names may contain more joints, in any order. Messages without names need exactly as many values. With
    names = "ignore" the first values are used in their order.
    """

    def __init__(self, part: StreamSpec, names: Names, key: str = "transport.topics.groups") -> None:
        self._part = part
        self._key = f"{key}.{part.source_key}.joints"  # configuration key, for messages
        self._check = names == "check"
        self._seen: tuple[str, ...] | None = None
        self._order: list[int] = []

    def read(self, message: JointState) -> tuple[Float64, Float64 | None, Float64 | None]:
        """Return position, velocity and effort, float64 [joints]; velocity and effort are None if the message lacks
        them.

        Raises UnusableMessage if the joints do not fit or a position is not finite.
        """
        order = self._indices(message)
        position = message.position[order]
        if not np.isfinite(position).all():
            raise UnusableMessage("not_finite", f"positions are {position.tolist()}; expected finite numbers")
        return (
            position,
            _optional_values(message.velocity, message, order),
            _optional_values(message.effort, message, order),
        )

    def _indices(self, message: JointState) -> list[int]:
        expected, size = self._part.joints, len(message.position)
        if not self._check or not message.names:
            enough = size >= len(expected) if not self._check else size == len(expected)
            if not enough:
                raise UnusableMessage(
                    "wrong_dimension",
                    f"{size} positions {'without names' if not message.names else ''} came; "
                    f"expected {len(expected)}: {', '.join(expected)}",
                )
            return list(range(len(expected)))
        if len(message.names) != size:
            raise UnusableMessage("wrong_dimension", f"{len(message.names)} names came with {size} positions")
        if message.names != self._seen:
            self._order = self._ordered(message.names)
            self._seen = message.names
        return self._order

    def _ordered(self, names: tuple[str, ...]) -> list[int]:
        expected = self._part.joints
        missing = [name for name in expected if name not in names]
        duplicates = [name for name in expected if names.count(name) > 1]
        if missing or duplicates:
            wrong = (
                f"lack {', '.join(missing)}" if missing else f"have {', '.join(duplicates)} more than once"
            )
            raise UnusableMessage(
                "joint_names",
                f"the joints {', '.join(names)} {wrong}; expected {', '.join(expected)} "
                f"({self._key} says what messages call them)",
            )
        return [names.index(name) for name in expected]


def _optional_values(numbers: Float64, message: JointState, order: list[int]) -> Float64 | None:
    """Return velocity or effort in the given order; None if a value is not finite or their number is wrong."""
    if len(numbers) != len(message.position):
        return None
    chosen = numbers[order]
    return chosen if np.isfinite(chosen).all() else None


def pose(message: PoseStamped, frame: str) -> Float32:
    """Return the pose as x, y, z [m], quaternion w, x, y, z; float32 [7].

    Raises UnusableMessage if it is in another frame than `frame`, not finite, or its quaternion is not of unit length.
    """
    message_frame = message.frame.lstrip("/")
    if frame and message_frame and message_frame != frame:
        raise UnusableMessage("wrong_frame", f"a pose is given in {message_frame}; expected {frame}")
    numbers = message.pose
    length = float(np.linalg.norm(numbers[3:]))
    if not np.isfinite(numbers).all() or abs(length - 1.0) > 0.05:
        raise UnusableMessage(
            "bad_pose", f"a pose is {numbers.tolist()}; expected a finite one, its quaternion unit"
        )
    return np.concatenate([numbers[:3], numbers[[6, 3, 4, 5]] / length]).astype(np.float32)


def check_picture(message: Image | CompressedImage) -> None:
    """Check, without decoding, that the function `picture` can decode the message. Raises UnusableMessage if not."""
    if isinstance(message, Image):
        _check_raw(message)
    elif _kind_of(message) is None:
        raise UnusableMessage(
            "wrong_encoding",
            f"a picture of format {message.format!r} begins with {bytes(message.data[:4]).hex() or 'nothing'}; "
            "allowed: jpeg, png (not compressedDepth)",
        )


def picture(message: Image | CompressedImage) -> UInt8:
    """Decode to RGB uint8 [H, W, 3], read-only. Raises UnusableMessage if that fails."""
    rgb = _raw(message) if isinstance(message, Image) else _decompressed(message)
    rgb.flags.writeable = False
    return rgb


def _check_raw(message: Image) -> None:
    channels = _CHANNELS.get(message.encoding)
    if channels is None:
        raise UnusableMessage(
            "wrong_encoding", f"a picture is {message.encoding!r}; allowed: {', '.join(sorted(_CHANNELS))}"
        )
    _check_size(message.height, message.width)
    needed = message.step * message.height
    if message.step < message.width * channels or len(message.data) < needed:
        raise UnusableMessage(
            "wrong_dimension",
            f"a picture of {message.width} x {message.height} {message.encoding} has rows of {message.step} bytes "
            f"and {len(message.data)} bytes; expected at least {message.width * channels} and {needed}",
        )


def _check_size(height: int, width: int) -> None:
    if not 0 < height * width <= MOST_PIXELS:
        raise UnusableMessage(
            "wrong_dimension", f"a picture has {width} x {height} pixels; allowed: 1 to {MOST_PIXELS}"
        )


def _raw(message: Image) -> UInt8:
    import cv2  # imported here because control locks its imports into memory

    _check_raw(message)
    channels, size = _CHANNELS[message.encoding], message.step * message.height
    rows = message.data[:size].reshape(message.height, message.step)[:, : message.width * channels]
    image = rows.reshape(message.height, message.width, channels)
    if message.encoding == "rgb8":
        return image.copy()
    code = {
        "bgr8": cv2.COLOR_BGR2RGB,
        "mono8": cv2.COLOR_GRAY2RGB,
        "rgba8": cv2.COLOR_RGBA2RGB,
        "bgra8": cv2.COLOR_BGRA2RGB,
    }[message.encoding]
    return np.asarray(cv2.cvtColor(image, code), np.uint8)


def _kind_of(message: CompressedImage) -> Literal["jpeg", "png"] | None:
    """Return the encoding that the picture's first bytes show; None if it is neither JPEG nor PNG, or is depth.

    The field `format` differs between drivers.
    """
    if "compressedDepth" in message.format:
        return None
    start = bytes(message.data[:8])
    return "jpeg" if start.startswith(_JPEG) else "png" if start == _PNG else None


def _decompressed(message: CompressedImage) -> UInt8:
    check_picture(message)
    try:
        decoded = _jpeg(message) if _kind_of(message) == "jpeg" else _png(message)
    except (ValueError, OSError, SyntaxError) as error:  # SyntaxError: Pillow's error for a broken PNG
        raise UnusableMessage(
            "broken_picture", f"a {message.format!r} picture cannot be decoded: {error}"
        ) from error
    # image_transport encodes with OpenCV, which expects BGR: after "compressed rgb8", red and blue are swapped in the
    # file.
    return np.ascontiguousarray(decoded[..., ::-1]) if "compressed rgb" in message.format else decoded


def _jpeg(message: CompressedImage) -> UInt8:
    import simplejpeg

    data = message.data.tobytes()
    height, width, _, _ = simplejpeg.decode_jpeg_header(data)
    _check_size(height, width)
    require_scans(data)
    return np.asarray(simplejpeg.decode_jpeg(data, "RGB"), np.uint8)


def _png(message: CompressedImage) -> UInt8:
    import io

    from PIL import Image as Pillow

    with Pillow.open(io.BytesIO(message.data.tobytes()), formats=["PNG"]) as opened:
        _check_size(opened.height, opened.width)
        if opened.mode not in ("1", "L", "LA", "P", "RGB", "RGBA"):
            raise UnusableMessage(
                "wrong_encoding", f"a PNG of mode {opened.mode} came; allowed: 8 bits per channel"
            )
        return np.array(opened.convert("RGB"), np.uint8)
