"""Deliberate faults of stand-in policy servers."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

NAMES = {
    "mute_on_connect": "accepts and never sends its metadata",
    "mute_on_infer": "answers :N requests, then none",
    "text_first": "sends a text frame where the metadata belong",
    "http_404": "refuses the websocket with HTTP 404",
    "close_mid_reply": "answers :N requests, then ends the connection within an answer",
    "die": "answers :N requests, then the process ends",
    "late_reply": "answers the second request :S seconds late (3), all others in time",
    "doubled": "answers the request number :N (0) twice at once",
    "doubled_late": "answers the request number :N (0) once more when the next one comes, before that",
    "too_large": "answers with a message of more than 64 MiB",
    "wrong_dim": "rows are one number short",
    "nan": "one number is NaN, at row 3, column 2",
    "empty": "no rows at all",
    "bad_array_dialect": "arrays as the package msgpack_numpy writes them",
    "object_array": "an array of pickled objects",
    "exception": "a traceback as text, then close code 1011",
    "batched": "actions [1, T, D]",
    "two_batches": "actions [2, T, D]",
    "single_row": "actions [D]",
    "action_mode": "says that its actions are :MODE",
    "no_rtc": "says that it continues no chunk, and continues none",
    "envelope_version": "with --rtc async_rtc: speaks version :N of the envelope (3)",
    "request_id": "with --rtc async_rtc, starvla, xpolicylab: answers carry the number of another request",
    "not_loaded": "vllm: says as JSON that no policy is served",
    "reset_text": "roboarena, vllm: answers a reset with another word",
    "normalized": "starvla: answers with rows that are yet to be un-normalised",
    "refused": "starvla, xpolicylab: answers with a map that says that the model failed",
    "unknown_endpoint": "gr00t: knows none of its endpoints",
    "error_bytes": "gr00t: answers with the bytes ERROR, as very old servers do",
    "malformed": "gr00t, lerobot, xpolicylab: answers with bytes that nobody can read",
    "two_frames": "gr00t: answers with two frames",
    "missing_key": "gr00t, xpolicylab: answers without one of its action keys",
    "unknown_key": "xpolicylab: answers with an action key that is none of the protocol's",
    "delta_key": "xpolicylab: answers with a change of the pose, too",
    "uneven": "gr00t: one action key has a row less than the others",
    "load_fails": "lerobot: cannot load what it is told to",
    "foreign_name": "lerobot: a pickle that would run a command",
    "other_step": "lerobot: rows for steps that nobody asked for",
    "shuffled": "lerobot: rows in another order than that of their steps",
    "other_rate": "lerobot: rows at twice the rate",
    "no_name": "lerobot: has its classes where version 0.3 had them",
}
TOO_LARGE = 64 * 1024 * 1024 + 1  # [bytes] of an oversized message


@dataclass(frozen=True, slots=True)
class Fault:
    """Fault of a server, one of NAMES or "none"; `argument` is the text after the colon on the command line."""

    name: str
    argument: str = ""

    def number(self, default: float) -> float:
        """Return the argument as a number; `default` if there is no argument."""
        return float(self.argument) if self.argument else default


NONE = Fault("none")


def parse(text: str) -> Fault:
    """Parse NAME[:ARG] of a command line.

    Raises:
        argparse.ArgumentTypeError: If the name is unknown, or the argument should be a number.
    """
    name, _, argument = text.partition(":")
    if name not in NAMES:
        raise argparse.ArgumentTypeError(f"{name!r} is no fault; allowed: {', '.join(NAMES)}")
    if argument and name != "action_mode":
        try:
            float(argument)
        except ValueError as error:
            raise argparse.ArgumentTypeError(
                f"{name}:{argument}: expected a number after the colon"
            ) from error
    return Fault(name, argument)
