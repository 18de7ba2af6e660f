"""Log of an episode's chunks: the policy's response together with its placement by control."""

from __future__ import annotations

import numpy as np

from runtime.core.types import Float32, UInt8
from runtime.ipc.messages import MergeResult, PolicyAnswer
from runtime.recording.base import Journal, RawChunk

_KEPT = 256  # most entries of either half that wait for the other


class ChunkLog:
    """Writer of the chunks of one episode.

    A chunk is written when both the policy's response and the placement by control are known. The two may come in
    either order. The methods raise RecordingError.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._answers: dict[int, PolicyAnswer] = {}
        self._merged: dict[int, MergeResult] = {}

    def add_answer(self, answer: PolicyAnswer) -> None:
        """Add a chunk as the policy returned it."""
        merged = self._merged.pop(answer.chunk_id, None)
        if merged is not None:
            self._write(answer, merged)
            return
        self._answers[answer.chunk_id] = answer
        if len(self._answers) > _KEPT:  # the oldest never reached control
            self._write(self._answers.pop(next(iter(self._answers))), None)

    def add_merge(self, merged: MergeResult) -> None:
        """Add control's report on the steps at which it has placed the rows of a chunk."""
        answer = self._answers.pop(merged.chunk_id, None)
        if answer is not None:
            self._write(answer, merged)
        elif len(self._merged) < _KEPT:
            self._merged[merged.chunk_id] = merged

    def flush(self) -> None:
        """Write the chunks that never reached control."""
        for answer in list(self._answers.values()):
            self._write(answer, None)

    def _write(self, answer: PolicyAnswer, merged: MergeResult | None) -> None:
        targets = np.full(len(answer.actions), -1, np.int64)
        if merged is not None:
            # A row of the policy belongs to the first step that was made from it.
            for step, row in zip(merged.targets[::-1], answer.source_rows[::-1], strict=True):
                targets[row] = step
        metres, radians, flags = _met(answer)
        self._journal.append(
            RawChunk(
                chunk_id=answer.chunk_id,
                observation_step=answer.observation_step,
                arrival_step=merged.arrival_step if merged else -1,
                actions=answer.actions,
                target_steps=targets,
                space="eef" if answer.space == "eef" else "joint",
                delay=merged.delay if merged else -1,
                mistimed=merged.mistimed if merged else 0,
                inference_ms=answer.inference_ms,
                strategy=merged.strategy if merged else "",
                overlap=merged.overlap if merged else 0,
                ik_position_error=metres,
                ik_rotation_error=radians,
                ik_flags=flags,
                eef=answer.eef,
            )
        )


def _met(answer: PolicyAnswer) -> tuple[Float32 | None, Float32 | None, UInt8 | None]:
    """Return position errors [m], rotation errors [rad] and IK flags for each row of the policy [H, arms].

    Several control steps may be computed from one row. The errors of a row are the largest errors of its steps, and its
    flags are the union of the flags of its steps. A row without steps has NaN and no flags. For a chunk of joints all
    three results are None.
    """
    errors, flags = (answer.position_error, answer.rotation_error), answer.ik_flags
    if errors[0] is None or errors[1] is None or flags is None:
        return None, None, None
    shape = (len(answer.actions), flags.shape[1])
    misses: list[Float32] = []
    for error in errors:
        assert error is not None
        worst = np.full(shape, np.nan, np.float32)
        np.fmax.at(worst, answer.source_rows, error.astype(np.float32))
        misses.append(worst)
    gathered = np.zeros(shape, np.uint8)
    np.bitwise_or.at(gathered, answer.source_rows, flags)
    return misses[0], misses[1], gathered
