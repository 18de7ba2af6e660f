"""Check of action rows in a reply: shape, width and finite numbers, for every protocol."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.core.errors import NotFiniteError, ShapeError
from runtime.core.types import Float32


def parse_action_rows(name: str, given: object, width: int | None = None) -> Float32:
    """Return the action rows of a reply as float32 [T, W]; [W] and [1, T, W] are accepted, too.

    Args:
        name: Name of the array in messages.
        given: Array of the reply.
        width: The only allowed W, None for any.

    Raises:
        ShapeError: Type, shape or width is wrong.
        NotFiniteError: A number is not finite; the message states its position.
    """
    if not isinstance(given, np.ndarray):
        raise ShapeError(f"{name} is a {type(given).__name__}; expected a number array [T, {width or 'W'}]")
    if given.dtype.kind not in "fiu":
        raise ShapeError(f"{name} has dtype {given.dtype.str}; expected floats or integers")
    rows = _two_dimensional(name, given)
    if rows.size == 0:
        raise ShapeError(f"{name} is empty, shape {list(given.shape)}; expected at least one row")
    if width is not None and rows.shape[1] != width:
        raise ShapeError(f"{name} has rows of {rows.shape[1]} numbers; this robot needs {width}")
    numbers = rows.astype(np.float32) if rows.dtype == np.float32 else _to_float32(rows)
    finite = np.isfinite(numbers)
    if not finite.all():  # the position is only searched after a failure, because every response passes here
        wrong = np.argwhere(~finite)
        row, column = wrong[0]
        raise NotFiniteError(
            f"{name} has {rows[row, column]} at row {row}, column {column} ({len(wrong)} such numbers); "
            "expected finite numbers"
        )
    return numbers


def _to_float32(rows: NDArray[Any]) -> Float32:
    """Convert to float32; a number beyond its range becomes infinite, which the check for finite numbers refuses."""
    with np.errstate(over="ignore"):
        return rows.astype(np.float32)


def _two_dimensional(name: str, rows: NDArray[Any]) -> NDArray[Any]:
    if rows.ndim == 1:
        return rows[None]
    if rows.ndim == 3 and rows.shape[0] == 1:
        return np.squeeze(rows, 0)
    if rows.ndim != 2:
        raise ShapeError(f"{name} has shape {list(rows.shape)}; expected [W], [T, W] or [1, T, W]")
    return rows
