"""The last samples of the joints: a page that draws fewer frames than samples come is shown all of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaweb.console import parts
from evaweb.console.parts import EncodedPart

SAMPLES = 12  # at the 30 a second that the runtime publishes: no gap down to three frames a second
_CURVES = ("measured", "raw", "planned", "executed")
_SAID = {"step": -1, "chunk": -1, "chunks": 0, "limited": False}  # and what their absence means


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    time: float
    curves: tuple[NDArray[np.float32], ...]
    columns: Mapping[str, Any]


class RecentSamples:
    """Makes stream `recent`: the newest samples in columns, oldest first, `t` on this process's clock [s].

    Arrays float32 [K, D]: `measured`; `raw`, what the newest chunk wants; `planned`, what was made of all
    chunks; `executed`, what was sent to the robot, or in simulation to the simulated one. NaN where there is
    none. Beside them per sample: `step`, the leading `chunk` (-1: none, 0: the held target), how many `chunks`
    made the step, whether safety `limited` it, whether the robot that executed was `simulated`. The samples of
    one part overlap with those of the part before.
    """

    def __init__(self) -> None:
        self._samples: deque[_Sample] = deque(maxlen=SAMPLES)

    def add_sample(
        self, vectors: Mapping[str, NDArray[Any]], words: Mapping[str, Any], now: float
    ) -> EncodedPart:
        """The stream after the sample of this moment."""
        sample = _sample(vectors, words, now)
        if self._samples and self._samples[-1].curves[0].shape != sample.curves[0].shape:
            self._samples.clear()  # another robot
        self._samples.append(sample)
        columns = {key: [one.columns[key] for one in self._samples] for key in sample.columns}
        arrays = {name: np.stack([one.curves[i] for one in self._samples]) for i, name in enumerate(_CURVES)}
        return parts.encode_numbers(
            "recent", {"t": [one.time for one in self._samples], **columns}, arrays, now
        )


def _sample(vectors: Mapping[str, NDArray[Any]], words: Mapping[str, Any], now: float) -> _Sample:
    nothing = np.full_like(vectors["measured"], np.nan)
    simulated = vectors.get("simulated", nothing)
    in_simulation = bool(np.isfinite(simulated).all())
    sent = vectors["commanded"] if words.get("engaged") else nothing
    curves = (
        vectors["measured"],
        vectors.get("raw", nothing),
        vectors.get("planned", nothing),
        simulated if in_simulation else sent,
    )
    said = {key: words.get(key, absent) for key, absent in _SAID.items()}
    return _Sample(now, curves, {**said, "simulated": in_simulation})
