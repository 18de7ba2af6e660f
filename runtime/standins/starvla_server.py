"""Stand-in for a StarVLA policy server: typed envelopes, a list of views, errors as maps."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from runtime.core.types import Float32, UInt8
from runtime.simulation.scripts.script import Answer, Script, WavingScript
from runtime.standins.arrays import packed, unpacked
from runtime.standins.faults import NONE, Fault
from runtime.standins.websocket_server import (
    Answering,
    Frames,
    WebsocketServer,
    apply_fault,
)

if TYPE_CHECKING:
    from robots import Robot


@dataclass(frozen=True, slots=True)
class StarvlaBehaviour:
    """Behaviour of the server; `views` are the robot's cameras in the order of a request, None for all.

    `size` is the image size of training that the server declares; `batched` is whether answers are [1, T, D]. If `old`,
    it behaves like servers until May 2026, which declare almost nothing and leave statistics to the client.
    """

    horizon: int = 16
    rate: float = 30.0
    latency: float = 0.0
    fault: Fault = NONE
    seed: int = 0
    views: tuple[str, ...] | None = None
    size: tuple[int, int] | None = (224, 224)
    batched: bool = True
    keys: tuple[str, ...] = ("stand_in",)
    old: bool = False


class StarvlaServer(WebsocketServer):
    """Stand-in for a StarVLA server, which listens on loopback.

    The server plays `script`; without a script it plays a gesture. `seen` and `pings` are logs of the requests, for
    tests.
    """

    def __init__(
        self, robot: Robot, star: StarvlaBehaviour, port: int = 0, script: Script | None = None
    ) -> None:
        super().__init__("starvla", star.fault, port)
        self.seen: list[dict[str, Any]] = []
        self.pings = 0
        self._star = star
        self._robot = robot
        self._views = star.views or tuple(camera.key for camera in robot.cameras)
        self._script = script or WavingScript(robot, star.horizon, star.rate, star.seed)
        # Joints at normalised values -1 and 1; the range of a joint without limits is one turn.
        self.low = np.where(np.isfinite(robot.lower), robot.lower, -np.pi)
        self.high = np.where(np.isfinite(robot.upper), robot.upper, np.pi)

    def greeting(self) -> Frames | None:
        """Return the server's first frame, as old or present servers send it."""
        star = self._star
        if star.old:
            return packed({"env": "simpler_env"})
        return packed(
            {
                "env": "starvla_policy_server",
                "ckpt_path": "stand-in",
                "action_chunk_size": star.horizon,
                "available_unnorm_keys": list(star.keys),
                "default_unnorm_key": star.keys[0] if len(star.keys) == 1 else None,
                "training_obs_image_size": star.size,
            }
        )

    def begin(self) -> Answering:
        """Return the function that answers the requests of a new connection."""
        answer = self._script.begin()
        return lambda request: packed(self._reply(answer, unpacked(_binary(request))))

    def _reply(self, answer: Answer, message: Any) -> dict[str, Any]:
        kind, number = message.get("type", "infer"), message.get("request_id", "default")
        if kind == "ping":
            self.pings += 1
            return {"status": "ok", "ok": True, "type": "ping", "request_id": number}
        failed = {"status": "error", "ok": False, "type": "inference_result", "request_id": number}
        if kind not in ("infer", "predict_action"):
            return failed | {
                "type": "unknown",
                "error": {"message": f"Unsupported message type '{kind}'"},
            }
        if self._star.fault.name == "refused":
            return failed | {"error": {"message": "CUDA out of memory (on purpose)"}}
        if self._star.fault.name == "request_id":
            number = f"{number}-other"
        try:
            rows = self._inferred(answer, message["payload"])
        except (KeyError, TypeError, ValueError, IndexError) as error:
            return failed | {"error": {"message": f"{type(error).__name__}: {error}"}}
        data = self._data(rows)
        return {
            "status": "ok",
            "ok": True,
            "type": "inference_result",
            "request_id": number,
            "data": data,
        }

    def _inferred(self, answer: Answer, payload: dict[str, Any]) -> Float32:
        started = time.monotonic()
        self.seen.append(payload)
        (example,) = payload["examples"]
        if (
            not self._star.old
            and len(self._star.keys) > 1
            and payload.get("unnorm_key") not in self._star.keys
        ):
            raise KeyError(f"unnorm_key {payload.get('unnorm_key')!r}; available: {self._star.keys}")
        pictures = self._pictures(example["image"])
        state = np.asarray(example["state"], np.float64)
        if state.shape != (1, self._robot.dim):
            raise ValueError(f"state is {state.shape}, expected (1, {self._robot.dim})")
        rows = answer(state[0], pictures, example["lang"])
        time.sleep(max(0.0, self._star.latency - (time.monotonic() - started)))
        return rows

    def _pictures(self, views: list[UInt8]) -> dict[str, UInt8]:
        if not isinstance(views, list) or len(views) != len(self._views):
            raise ValueError(
                f"image is a {type(views).__name__} of {len(views)}, expected {len(self._views)} views"
            )
        for view in views:
            if view.dtype != np.uint8 or view.ndim != 3 or view.shape[-1] != 3:
                raise ValueError(f"a view is {view.dtype} {view.shape}, expected uint8 [H, W, 3]")
        return dict(zip(self._views, views, strict=True))

    def _data(self, rows: Float32) -> dict[str, Any]:
        fault = self._star.fault
        normalized = self._star.old or fault.name == "normalized"
        if normalized:
            rows = (2 * (rows - self.low) / (self.high - self.low) - 1).astype(np.float32)
        well = fault.name in ("none", "normalized")
        data = apply_fault(fault, rows if normalized or not well else rows.astype(np.float64))
        plain = isinstance(data, np.ndarray) and data.ndim == 2 and well
        name = "normalized_actions" if normalized else "actions"
        return {name: data[None] if plain and self._star.batched else data}


def _binary(request: str | bytes) -> bytes:
    if isinstance(request, str):
        raise TypeError("a bytes-like object is required, not 'str'")
    return request
