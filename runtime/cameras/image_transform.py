"""Processing of a camera's pictures: colours, crop, rotation, flip, size."""

from __future__ import annotations

import numpy as np

from runtime.cameras.base import LARGEST, CameraError, CameraSettings
from runtime.core.types import UInt8


class ImageTransform:
    """Transformation of one camera's pictures.

    All pictures must have the size of the first one: recordings and policies depend on it.
    """

    def __init__(self, settings: CameraSettings) -> None:
        self._settings = settings
        self._source: tuple[int, int] | None = None  # width, height of the first picture

    def __call__(self, picture: UInt8) -> UInt8:
        """Return `picture` [H, W, 3] transformed, contiguous and read-only.

        Raises CameraError if the picture cannot be used.
        """
        import cv2

        settings = self._settings
        self._check(picture.shape[1], picture.shape[0])
        if settings.colours == "bgr":
            picture = picture[:, :, ::-1]
        if settings.crop is not None:
            left, top, width, height = settings.crop
            picture = picture[top : top + height, left : left + width]
        picture = np.rot90(picture, -settings.rotate // 90)
        if settings.flip != "none":
            picture = picture[:, ::-1] if settings.flip == "horizontal" else picture[::-1]
        picture = np.ascontiguousarray(picture)
        if settings.size is not None and list(picture.shape[1::-1]) != settings.size:
            shrinks = picture.shape[1] > settings.size[0]
            how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            picture = np.asarray(cv2.resize(picture, tuple(settings.size), interpolation=how), np.uint8)
        if picture.nbytes > LARGEST:
            raise CameraError(
                f"its pictures are {picture.shape[1]}x{picture.shape[0]}, and 1920x1080 is the most that is handed "
                "on: set size or crop"
            )
        picture.flags.writeable = False
        self._source = self._source or self._given
        return picture

    def _check(self, width: int, height: int) -> None:
        settings = self._settings
        self._given = (width, height)
        if settings.crop is not None:
            left, top, wide, high = settings.crop
            if left + wide > width or top + high > height:
                raise CameraError(f"crop = {settings.crop} does not lie within its {width}x{height} pixels")
        if self._source in (None, (width, height)):
            return
        before = f"{self._source[0]}x{self._source[1]}"
        if settings.crop is None and settings.size is not None:
            if self._source[0] * height == self._source[1] * width:
                return
            raise CameraError(f"its pictures were {before} and are {width}x{height} now, of another shape")
        raise CameraError(
            f"its pictures were {before} and are {width}x{height} now; set it back, or size without crop, or "
            "restart the station"
        )
