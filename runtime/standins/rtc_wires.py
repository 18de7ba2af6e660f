"""Formats in which the stand-in policy server receives the rows that the robot is committed to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from runtime.standins.arrays import packed
from runtime.standins.continuing import STAND_IN, CommittedPrefix, ModelSpace
from runtime.standins.faults import Fault

Name = Literal["none", "prev_action", "openpi_rtc", "kai0", "async_rtc"]
_SHIFT, _FROZEN = 25, 10  # rows that openpi-rtc drops, and rows that it continues exactly
_ENVELOPE, _VERSION = "openpi-async-rtc", 2
_FIELDS = (
    "prev_chunk_left_over",
    "inference_delay",
    "execution_horizon",
    "prefix_attention_schedule",
    "max_guidance_weight",
)


@dataclass(frozen=True, slots=True)
class ParsedRequest:
    """Parsed request: the observation, the prefix to continue (or None), and the request's number (or None)."""

    observation: dict[str, Any]
    prefix: CommittedPrefix | None = None
    number: int | None = None


class Wire(ABC):
    """Wire format: parses requests and builds answers; `fault` may change either."""

    def __init__(self, space: ModelSpace, horizon: int, fault: Fault) -> None:
        self._space = space
        self._horizon = horizon
        self._fault = fault

    @abstractmethod
    def metadata(self) -> dict[str, object]:
        """Return the metadata of the format, sent on connection."""

    @abstractmethod
    def read(self, message: Any) -> ParsedRequest:
        """Parse a request. Raises an exception, whose type depends on the mistake, if the request is invalid."""

    @abstractmethod
    def answer(self, result: dict[str, object], asked: ParsedRequest) -> bytes:
        """Return the frame with `result` that answers the request `asked`."""

    @abstractmethod
    def failure(self, traceback: str, message: Any) -> str | bytes:
        """Return the frame that reports an error in a request."""

    @property
    def _continues(self) -> bool:
        return self._fault.name != "no_rtc"


class NoRtcWire(Wire):
    """Format of most servers, without RTC: unknown keys are ignored silently."""

    def metadata(self) -> dict[str, object]:
        return {}

    def read(self, message: Any) -> ParsedRequest:
        return ParsedRequest(message)

    def answer(self, result: dict[str, object], asked: ParsedRequest) -> bytes:
        return packed(result)

    def failure(self, traceback: str, message: Any) -> str | bytes:
        return traceback


class PrevActionWire(NoRtcWire):
    """Format with RTC keys in the observation.

    A request states how many rows of the previous chunk the robot has consumed, but no delay. The stand-in uses the
    number of consumed rows as the delay: the answer begins with that many rows of the rest of the previous chunk.
    """

    def metadata(self) -> dict[str, object]:
        dialect = "prev_action" if self._continues else "none"
        return {"rtc": {"dialect": dialect, "stand_in": STAND_IN}}

    def read(self, message: Any) -> ParsedRequest:
        if not self._continues or "prev_action" not in message:
            return ParsedRequest(message)
        rows = self._space.joints(message["prev_action"])
        consumed = message["rtc_params"]["s"]
        if not isinstance(consumed, int) or not 0 <= consumed < len(rows):
            raise ValueError(f"rtc_params.s is {consumed!r}, expected 0 to {len(rows) - 1}")
        left = rows[: len(rows) - consumed]
        return ParsedRequest(message, CommittedPrefix(left, consumed, len(left)))


class OpenpiRtcWire(NoRtcWire):
    """Format of openpi-rtc: the server drops a fixed number of rows of the previous chunk, whatever was executed."""

    @property
    def _shift(self) -> int:
        return min(_SHIFT, self._horizon // 2)

    def metadata(self) -> dict[str, object]:
        dialect = "openpi_rtc" if self._continues else "none"
        return {"rtc": {"dialect": dialect, "stand_in": STAND_IN, "shift": self._shift}}

    def read(self, message: Any) -> ParsedRequest:
        observation = message.get("obs", message)
        if not self._continues or not message.get("is_rtc") or "prev_action" not in message:
            return ParsedRequest(observation)
        left = self._space.joints(message["prev_action"])[self._shift :]
        return ParsedRequest(observation, CommittedPrefix(left, min(_FROZEN, len(left)), len(left)))


class Kai0Flat(NoRtcWire):
    """Format of kai0: row n of the previous chunk corresponds to row n of the new chunk."""

    def metadata(self) -> dict[str, object]:
        return {"rtc": {"dialect": "kai0" if self._continues else "none", "stand_in": STAND_IN}}

    def read(self, message: Any) -> ParsedRequest:
        delay, end = message["inference_delay"], message["execute_horizon"]
        if not isinstance(delay, int) or not isinstance(end, int) or delay < 0 or end < 1:
            raise ValueError(f"inference_delay {delay!r}, execute_horizon {end!r}: expected 0 and 1 or more")
        if not self._continues or "prev_action_chunk" not in message:
            return ParsedRequest(message)
        rows = np.asarray(message["prev_action_chunk"], np.float64)
        if rows.ndim != 2 or rows.shape[1] < self._space.dim:
            raise ValueError(
                f"prev_action_chunk has shape {rows.shape}, expected [T, {self._space.dim}] or wider"
            )
        end = max(delay, min(end, len(rows)))
        return ParsedRequest(message, CommittedPrefix(rows[:, : self._space.dim], delay, end))


class Envelope(Wire):
    """Format of openpi-async-rtc, version 2: requests and answers in versioned envelopes."""

    def metadata(self) -> dict[str, object]:
        return {
            "rtc": {"dialect": "async_rtc", "stand_in": STAND_IN},
            "async_rtc": {
                **self._head(),
                "model_action_horizon": self._horizon,
                "model_action_dim": self._space.width,
                "rtc_supported": self._continues,
                "image_transport_codecs": ["raw"],
            },
        }

    def read(self, message: Any) -> ParsedRequest:
        version = (message.get("protocol"), message.get("protocol_version"))
        if version != (_ENVELOPE, _VERSION):
            raise ValueError(
                f"protocol {version[0]!r} version {version[1]!r}; expected {_ENVELOPE!r} version 2"
            )
        number, codec = message.get("request_id"), message["image_transport"]["codec"]
        if not isinstance(number, int) or number < 0:
            raise ValueError(f"request_id is {number!r}, expected 0 or more")
        if codec != "raw":
            raise ValueError(f"image_transport.codec is {codec!r}, expected 'raw'")
        rtc = message.get("rtc")
        prefix = None if rtc is None or not self._continues else self._prefix(rtc)
        return ParsedRequest(message["observation"], prefix, number)

    def answer(self, result: dict[str, object], asked: ParsedRequest) -> bytes:
        number = asked.number
        if self._fault.name == "request_id" and number is not None:
            number += 1
        timing = {"image_decode_ms": 0.0, "codec": "raw"}
        whole = {**self._head(), "request_id": number, "result": {**result, "image_transport": timing}}
        return packed(whole)

    def failure(self, traceback: str, message: Any) -> str | bytes:
        number = message.get("request_id") if isinstance(message, dict) else None
        request_id = number if isinstance(number, int) else None
        return packed({**self._head(), "request_id": request_id, "error": traceback})

    def _head(self) -> dict[str, object]:
        version = _VERSION
        if self._fault.name == "envelope_version":
            version = int(self._fault.number(_VERSION + 1))
        return {"protocol": _ENVELOPE, "protocol_version": version}

    def _prefix(self, rtc: Any) -> CommittedPrefix:
        missing = [name for name in _FIELDS if name not in rtc]
        if missing:
            raise KeyError(f"rtc has no {', '.join(missing)}")
        rows = self._space.joints(np.asarray(rtc["prev_chunk_left_over"]))
        delay, end = rtc["inference_delay"], rtc["execution_horizon"]
        if not 0 <= delay <= end <= self._horizon:
            raise ValueError(
                f"inference_delay {delay} and execution_horizon {end}: expected 0 <= delay <= execution_horizon "
                f"<= {self._horizon}"
            )
        return CommittedPrefix(rows, delay, end)


WIRES: dict[Name, type[Wire]] = {
    "none": NoRtcWire,
    "prev_action": PrevActionWire,
    "openpi_rtc": OpenpiRtcWire,
    "kai0": Kai0Flat,
    "async_rtc": Envelope,
}
