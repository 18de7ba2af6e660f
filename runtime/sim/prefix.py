"""How a scripted policy continues the chunk that is being executed: a stand-in, no evidence for a model.

It does what a model does that was trained on prefixes (Black et al., Training-Time Action Conditioning for Efficient
Real-Time Chunking, arXiv 2512.05964): the rows that the robot is committed to come first, unchanged, and the
policy's own go on from there.
"""

from __future__ import annotations

import numpy as np

from runtime.types import Float32


def continued(rows: Float32, prefix: Float32, stride: float) -> Float32:
    """`rows` [H, D] with the first ones replaced by `prefix` [d, D]; after it no number changes by more than `stride`
    a row until it is where `rows` has it."""
    kept = len(prefix)
    if not 0 < kept < len(rows):
        return prefix[: len(rows)].copy() if kept else rows
    last = prefix[-1]
    reach = stride * np.arange(1, len(rows) - kept + 1, dtype=np.float32)[:, None]
    return np.concatenate([prefix, last + np.clip(rows[kept:] - last, -reach, reach)])
