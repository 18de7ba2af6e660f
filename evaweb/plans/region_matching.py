"""Regions of a reference picture around objects, and the match of a live picture in each.

A region's match is the largest normalised cross-correlation of the three colours within TOLERANCE of the drawn place.
It is computed at the camera's own resolution, but at most 640 pixels wide. Both pictures are band-passed first to
details of 5 to 33 pixels, which removes sensor noise and slowly varying light. Brightness has no influence, nor has
contrast between half and double; beyond that the match decreases, so that a faint trace of an object does not match.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from evaweb.core.errors import EvaError
from evaweb.plans.image_store import brought, decoded
from runtime.core.sentences import Pattern

_REGIONS_GIVEN = Pattern("plans.regions.regions_given", "regions: {where}: {msg} (given: {input!r:.80})")
_REGIONS_THERE_TWICE_ALLOWED_EACH = Pattern(
    "plans.regions.regions_there_twice_allowed_each",
    "regions: {twice!r} is there twice; allowed: each name once",
)
_REGION_X_PIXELS_PICTURE_ALLOWED = Pattern(
    "plans.regions.region_x_pixels_picture_allowed",
    "region {name!r}: {right} x {bottom} pixels of the picture; allowed: {least} x {least} or more",
)
_REGION_ONE_COLOUR_PICTURE_DRAW = Pattern(
    "plans.regions.region_one_colour_picture_draw",
    "region {name!r} is of one colour in the picture: draw it around an object and its edges",
)
_REGION_HAS_NO_PIXEL_PICTURE = Pattern(
    "plans.regions.region_has_no_pixel_picture",
    "region {name!r} has no pixel in a picture of {shape} x {shape_2}; allowed: pictures as large as "
    "the reference is",
)

MOST = 12  # regions per picture
WIDEST = 640  # width at which pictures are compared [px]
TOLERANCE = (
    4  # allowed displacement [px at WIDEST]: movement of a camera, far less than of a misplaced object
)
REACH = 40  # search radius for a displaced object [px at WIDEST]
_LEAST = 8  # smallest side of a region [px]
_SEEN = 0.75  # match at which a displaced object counts as recognised
_FLAT = 1.5  # spread below which a region is uniform [grey levels]
_FINE, _COARSE = 2, 16  # half widths of the two averaging windows of the band-pass [px]

_Pixels = np.ndarray[tuple[int, ...], np.dtype[Any]]
_Share = Annotated[float, Field(ge=0, le=1)]


class Region(BaseModel):
    """A named rectangle: its upper left corner and its size, as fractions of the picture's width and height."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    name: str = Field(min_length=1, max_length=40)
    x: _Share
    y: _Share
    width: _Share
    height: _Share

    @model_validator(mode="after")
    def _inside(self) -> Region:
        if self.x + self.width > 1 + 1e-6 or self.y + self.height > 1 + 1e-6:
            raise ValueError("it reaches beyond the picture; allowed: x + width and y + height up to 1")
        return self


_REGIONS = TypeAdapter(Annotated[list[Region], Field(max_length=MOST)])


def regions_of(given: Any) -> list[Region]:
    """Return the validated regions with distinct names. Raises: EvaError with the first problem."""
    try:
        regions = _REGIONS.validate_python(given)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "regions"
        raise EvaError(_REGIONS_GIVEN(where=where, msg=first["msg"], input=first["input"])) from None
    names = [region.name for region in regions]
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise EvaError(_REGIONS_THERE_TWICE_ALLOWED_EACH(twice=repeated))
    return regions


def check_sizes(found: list[Region], jpeg: bytes) -> None:
    """Raise EvaError if a region is too small on this picture, or too uniform to be recognised."""
    picture = _to_common_size([decoded(jpeg, "RGB")])[0]
    for region in found:
        top, left, bottom, right = _box(region, picture)
        if bottom - top < _LEAST or right - left < _LEAST:
            raise EvaError(
                _REGION_X_PIXELS_PICTURE_ALLOWED(
                    name=region.name, right=right - left, bottom=bottom - top, least=_LEAST
                )
            )
        if _spread(_band_passed(picture, (top, left, bottom, right))) < _FLAT:
            raise EvaError(_REGION_ONE_COLOUR_PICTURE_DRAW(name=region.name))


def match_regions(found: list[Region], reference: bytes, now: bytes) -> list[dict[str, Any]]:
    """Return for each region a dict with the keys "name", "at", "match", "dx", "dy" and "words".

    "at" is the region, [x, y, width, height] as fractions of the picture. "match" ranges from 1 (identical) to 0. "dx"
    (to the right) and "dy" (down) are the displacement of the object in pixels of the live picture `now`, None if the
    object is not recognised. "words" is the same as text. Raises: EvaError if the live picture is so small that a
    region has no pixel.
    """
    live = decoded(now, "RGB")
    before, after = _to_common_size([decoded(reference, "RGB"), live])
    scale = (live.shape[1] / after.shape[1], live.shape[0] / after.shape[0])
    return [
        {
            "name": region.name,
            "at": [region.x, region.y, region.width, region.height],
            **_found(region, before, after, scale),
        }
        for region in found
    ]


def _found(region: Region, before: _Pixels, after: _Pixels, scale: tuple[float, float]) -> dict[str, Any]:
    top, left, bottom, right = box = _box(region, before)
    if bottom == top or right == left:
        raise EvaError(
            _REGION_HAS_NO_PIXEL_PICTURE(name=region.name, shape=after.shape[1], shape_2=after.shape[0])
        )
    pattern = _band_passed(before, box)
    around = (top - REACH, left - REACH, bottom + REACH, right + REACH)
    first_row, first_column, last_row, last_column = _inside(around, after)
    places = _correlations(pattern, _band_passed(after, (first_row, first_column, last_row, last_column)))
    down = np.arange(places.shape[0]) + first_row - top
    across = np.arange(places.shape[1]) + first_column - left
    near = places[np.ix_(np.abs(down) <= TOLERANCE, np.abs(across) <= TOLERANCE)]
    row, column = np.unravel_index(int(places.argmax()), places.shape)
    right, below = int(across[column]), int(down[row])
    recognised = (
        places[row, column] >= _SEEN and max(abs(right), abs(below)) < REACH
    )  # a maximum at the edge of the search area is not a peak
    dx, dy = round(right * scale[0]), round(below * scale[1])
    return {
        "match": round(float(np.clip(near.max(), 0, 1)), 4),
        "dx": dx if recognised else None,
        "dy": dy if recognised else None,
        "words": _words(dx, dy) if recognised else "not recognised here or nearby",
    }


def _words(dx: int, dy: int) -> str:
    sides = ((dx, "to the right", "to the left"), (dy, "down", "up"))
    moved = [f"{abs(by)} px {more if by > 0 else less}" for by, more, less in sides if abs(by) > TOLERANCE]
    return ", ".join(moved) or "in its place"


def _correlations(pattern: _Pixels, around: _Pixels) -> _Pixels:
    """Return the match of `pattern` at each position of `around` where it fits entirely."""
    height, width, _ = pattern.shape
    shape = around.shape[:2]
    centred = pattern - pattern.mean(axis=(0, 1))
    mine = max(float((centred**2).sum()), 1e-9)
    spectrum = np.fft.rfft2(around, axes=(0, 1)) * np.conj(np.fft.rfft2(centred, s=shape, axes=(0, 1)))
    rows, columns = shape[0] - height + 1, shape[1] - width + 1
    both = np.fft.irfft2(spectrum.sum(axis=2), s=shape, axes=(0, 1))[:rows, :columns]
    pixels = height * width
    sums, squares = _sums(around, height, width), _sums(around**2, height, width)
    variance = np.maximum((squares - sums**2 / pixels).sum(axis=2), 1e-9)
    contrast = np.sqrt(variance / mine)
    fade = np.minimum(1.0, 2 * np.minimum(contrast, 1 / contrast))
    correlations: _Pixels = both / np.sqrt(mine * variance) * fade
    return correlations


def _sums(values: _Pixels, height: int, width: int) -> _Pixels:
    """Return the sums of the values in each window of this size."""
    total = np.pad(values.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0), (0, 0)))
    inside: _Pixels = (
        total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    )
    return inside


def _spread(values: _Pixels) -> float:
    return float(np.sqrt(((values - values.mean(axis=(0, 1))) ** 2).sum(axis=2).mean()))


def _box(region: Region, picture: _Pixels) -> tuple[int, int, int, int]:
    """Return the region's first row, first column, last row + 1 and last column + 1 in the picture."""
    height, width = picture.shape[:2]
    return (
        round(region.y * height),
        round(region.x * width),
        round((region.y + region.height) * height),
        round((region.x + region.width) * width),
    )


def _to_common_size(pictures: list[_Pixels]) -> list[_Pixels]:
    """Scale the pictures to the size of the smallest, at most WIDEST wide."""
    height = min(picture.shape[0] for picture in pictures)
    width = min(picture.shape[1] for picture in pictures)
    if width > WIDEST:
        height, width = round(height * WIDEST / width), WIDEST
    return [
        picture if picture.shape[:2] == (height, width) else brought(picture, height, width)
        for picture in pictures
    ]


def _band_passed(picture: _Pixels, box: tuple[int, int, int, int]) -> _Pixels:
    """Return the band-passed box of the picture, filtered with the surrounding pixels."""
    top, left, bottom, right = box
    wide = (top - _COARSE, left - _COARSE, bottom + _COARSE, right + _COARSE)
    first_row, first_column, last_row, last_column = _inside(wide, picture)
    missing = (
        (first_row - wide[0], wide[2] - last_row),
        (first_column - wide[1], wide[3] - last_column),
        (0, 0),
    )
    padded = np.pad(
        picture[first_row:last_row, first_column:last_column].astype(np.float64), missing, mode="edge"
    )
    inner = padded[_COARSE - _FINE : _FINE - _COARSE, _COARSE - _FINE : _FINE - _COARSE]
    return _means(inner, 2 * _FINE + 1) - _means(padded, 2 * _COARSE + 1)


def _means(values: _Pixels, side: int) -> _Pixels:
    return _sums(values, side, side) / side**2


def _inside(box: tuple[int, int, int, int], picture: _Pixels) -> tuple[int, int, int, int]:
    """Return the box clipped to the picture."""
    return max(0, box[0]), max(0, box[1]), min(picture.shape[0], box[2]), min(picture.shape[1], box[3])
