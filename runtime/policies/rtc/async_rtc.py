"""Dialect openpi-async-rtc, version 2: a versioned envelope with numbered requests and with errors as messages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from runtime.core.errors import ServerReportedError, WrongProtocolError
from runtime.core.types import Conditioning
from runtime.policies.rtc.base import Dialect, Message
from runtime.policies.websocket_link import error_headline

NAME = "openpi-async-rtc"
VERSION = 2
Schedule = Literal["exp", "linear", "ones", "zeros"]


class AsyncRtc(Dialect):
    """Dialect with one request at a time, whose number the response must repeat.

    The part `rtc` of a request contains the rest of the previous chunk, the predicted delay, and `execution_horizon`.
    In this dialect `execution_horizon` is the row at which the transition from the previous chunk to new rows ends:
    never below the delay, never above the model's horizon.
    """

    def __init__(self, schedule: Schedule, max_guidance_weight: float) -> None:
        self._schedule = schedule
        self._weight = max_guidance_weight
        self._number = -1
        self._horizon: int | None = None

    def check_supported(self, metadata: Mapping[str, Any]) -> bool | None:
        """Return the server's `rtc_supported`: whether it continues a previous chunk.

        Raises PolicyError if protocol, version or codec is wrong, or `rtc_supported` is not a bool.
        """
        fields = metadata.get("async_rtc")
        if not isinstance(fields, Mapping):
            keys = ", ".join(map(str, metadata)) or "nothing"
            raise WrongProtocolError(
                f"the server's metadata have no async_rtc map, only {keys}: it is no {NAME} server; correct "
                "policy.rtc or policy.url"
            )
        _check_version(fields, "the server's async_rtc metadata")
        codecs = fields.get("image_transport_codecs", ["raw"])
        if not isinstance(codecs, list) or "raw" not in codecs:
            raise WrongProtocolError(f"the server takes pictures as {codecs!r}; needed: raw")
        supported = fields.get("rtc_supported")
        if not isinstance(supported, bool):
            raise WrongProtocolError(
                f"the server's async_rtc metadata have rtc_supported {supported!r}; needed: a bool"
            )
        horizon = fields.get("model_action_horizon")
        self._horizon = horizon if type(horizon) is int else None
        return supported

    def wrap(self, observation: Message, conditioning: Conditioning | None) -> Message:
        """Return the envelope for the next request."""
        self._number += 1
        return {
            "protocol": NAME,
            "protocol_version": VERSION,
            "request_id": self._number,
            "observation": observation,
            "image_transport": {"codec": "raw"},
            "rtc": None if conditioning is None else self._rtc(conditioning),
        }

    def unwrap(self, reply: Message) -> Message:
        """Return the content of the response's envelope.

        Raises PolicyError if the server reports an error, or the version or request number differs.
        """
        _check_version(reply, "the answer")
        if reply.get("error"):
            raise ServerReportedError(
                f"the policy server reports an error: {error_headline(str(reply['error']))}"
            )
        number = reply.get("request_id")
        if number != self._number:
            raise WrongProtocolError(
                f"the answer has request_id {number!r}, asked was {self._number}: it is another request's"
            )
        result = reply.get("result")
        if not isinstance(result, dict):
            raise WrongProtocolError(
                f"the answer has a result that is a {type(result).__name__}; expected a map"
            )
        return result

    def _rtc(self, conditioning: Conditioning) -> Message:
        left = conditioning.remaining_rows
        delay = min(conditioning.predicted_delay, len(left))  # only the rows in `left` can be committed
        highest = len(conditioning.previous) if self._horizon is None else self._horizon
        return {
            "prev_chunk_left_over": np.ascontiguousarray(left, np.float32),
            "inference_delay": delay,
            "execution_horizon": max(1, delay, min(conditioning.execution_horizon, highest)),
            "prefix_attention_schedule": self._schedule,
            "max_guidance_weight": self._weight,
        }


def _check_version(message: Mapping[str, Any], where: str) -> None:
    version = (message.get("protocol"), message.get("protocol_version"))
    if version != (NAME, VERSION):
        raise WrongProtocolError(
            f"{where} has protocol {version[0]!r} version {version[1]!r}; needed: {NAME!r} version {VERSION}"
        )
