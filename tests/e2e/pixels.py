"""What a pane shows, as numbers: pages are judged by their pixels, not by their source text."""

import io

import numpy as np
from PIL import Image


def pixels(element):
    """The element as the browser draws it: uint8 [H, W, 3]."""
    return np.asarray(Image.open(io.BytesIO(element.screenshot())).convert("RGB"))


def share(picture, inside):
    """The share of pixels for which `inside(r, g, b)` (float 0..1 planes) holds."""
    red, green, blue = np.moveaxis(picture.astype(float) / 255, -1, 0)
    return float(inside(red, green, blue).mean())


def orange(red, green, blue):
    """The block."""
    return (red > 0.6) & (green < 0.55 * red) & (blue < 0.35 * red)


def white(red, green, blue):
    """The shells of the arms."""
    return (red > 0.7) & (green > 0.7) & (blue > 0.7)


def wood(red, green, blue):
    """The table."""
    return (red > 0.4) & (red > 1.08 * blue) & (green > blue) & (red < 0.95) & (green > 0.7 * red)


def grey(picture):
    """Whether a picture has no colour."""
    return int(np.ptp(picture.astype(int), axis=-1).max()) < 25


def moved(before, after):
    """The share of pixels that clearly changed."""
    return float((np.abs(before.astype(int) - after.astype(int)).max(-1) > 30).mean())
