"""How many examples a property test with a number of its own takes: few in the gate, all in `make labs`."""

from __future__ import annotations

import hypothesis


def some(count: int) -> int:
    """A third of `count` where the gate's profile holds, `count` with that of random examples."""
    return max(5, count // 3) if hypothesis.settings().derandomize else count
