"""Preparation of pictures for policies: size as in their training, and memory layout."""

from __future__ import annotations

from typing import Literal

import numpy as np

from runtime.core.types import UInt8

Resize = Literal["pad", "stretch"]
Layout = Literal["chw", "hwc"]


def resize_image(
    picture: UInt8, height: int, width: int, how: Resize, by: Literal["bilinear", "lanczos"] = "bilinear"
) -> UInt8:
    """Resize a picture [H, W, 3] to RGB uint8 [height, width, 3], with Pillow because policies are trained with it.

    "stretch" scales both sides independently. "pad" preserves the aspect ratio and centres the picture on black; sides
    are rounded down as in openpi.
    """
    rows, columns = picture.shape[:2]
    if (rows, columns) == (height, width):
        return picture
    from PIL import Image

    image = Image.fromarray(picture)
    filtered = Image.Resampling.BILINEAR if by == "bilinear" else Image.Resampling.LANCZOS
    if how == "stretch":
        return np.asarray(image.resize((width, height), filtered))
    ratio = max(columns / width, rows / height)
    inner_width, inner_height = max(1, int(columns / ratio)), max(1, int(rows / ratio))
    top, left = (height - inner_height) // 2, (width - inner_width) // 2
    canvas = np.zeros((height, width, 3), np.uint8)
    inner = np.asarray(image.resize((inner_width, inner_height), filtered))
    canvas[top : top + inner_height, left : left + inner_width] = inner
    return canvas


def to_layout(picture: UInt8, layout: Layout) -> UInt8:
    """Return the picture in memory order: [H, W, 3] for "hwc", [3, H, W] for "chw"."""
    if layout == "hwc":
        return np.ascontiguousarray(picture)
    import cv2  # imported here because control locks its imports into memory

    planes = np.empty((3, *picture.shape[:2]), np.uint8)
    cv2.split(picture, list(planes))  # directly into their memory, ten times as fast as numpy's transpose
    return planes
