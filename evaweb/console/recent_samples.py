"""Recent joint samples: a page that draws fewer frames than there are samples still gets all of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaweb.console import frame_parts
from evaweb.console.frame_parts import EncodedPart

SAMPLES = 12  # at 30 samples per second this covers down to three frames per second
_CURVES = ("measured", "raw", "planned", "executed")
_SAID = {
    "step": -1,
    "chunk": -1,
    "chunks": 0,
    "limited": False,
}  # keys of a sample, with the default of a missing one


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    time: float
    curves: tuple[NDArray[np.float32], ...]
    columns: Mapping[str, Any]


class RecentSamples:
    """Builder of stream `recent`: the newest samples, oldest first. Consecutive parts overlap.

    Each part has these arrays float32 [K, D], in which missing values are NaN:

    * `measured`: the measured joints.
    * `raw`: the rows of the newest chunk.
    * `planned`: the merged plan.
    * `executed`: commands sent to the robot or, in simulation, to the simulated robot.

    It also has lists with one value per sample:

    * `t`: time on this process's clock [s].
    * `step`: control step.
    * `chunk`: the chunk with the largest weight (-1: no chunk, 0: hold target).
    * `chunks`: number of chunks that contributed.
    * `limited`: whether safety limited the command.
    * `simulated`: whether the executing robot was simulated.
    """

    def __init__(self) -> None:
        self._samples: deque[_Sample] = deque(maxlen=SAMPLES)

    def add_sample(
        self, vectors: Mapping[str, NDArray[Any]], words: Mapping[str, Any], now: float
    ) -> EncodedPart:
        """Add the sample measured at `now`, and return the encoded part of the stream with all recent samples.

        `vectors` and `words` are the numeric and the other values of the sample, by name.
        """
        sample = _sample(vectors, words, now)
        if self._samples and self._samples[-1].curves[0].shape != sample.curves[0].shape:
            self._samples.clear()  # another robot
        self._samples.append(sample)
        columns = {key: [recent.columns[key] for recent in self._samples] for key in sample.columns}
        arrays = {
            name: np.stack([recent.curves[i] for recent in self._samples]) for i, name in enumerate(_CURVES)
        }
        return frame_parts.encode_numbers(
            "recent", {"t": [recent.time for recent in self._samples], **columns}, arrays, now
        )


def _sample(vectors: Mapping[str, NDArray[Any]], facts: Mapping[str, Any], now: float) -> _Sample:
    nothing = np.full_like(vectors["measured"], np.nan)
    simulated = vectors.get("simulated", nothing)
    in_simulation = bool(np.isfinite(simulated).all())
    sent = vectors["commanded"] if facts.get("engaged") else nothing
    curves = (
        vectors["measured"],
        vectors.get("raw", nothing),
        vectors.get("planned", nothing),
        simulated if in_simulation else sent,
    )
    columns = {key: facts.get(key, absent) for key, absent in _SAID.items()}
    return _Sample(now, curves, {**columns, "simulated": in_simulation})
