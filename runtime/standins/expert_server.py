"""Scripted experts of a benchmark as a policy server of openpi's protocol, run in the benchmark's environment.

The benchmark's own observation vector is in `observation/environment_state`; the state of a robot alone does not show
where the objects are.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from runtime.simulation import program
from runtime.standins.arrays import packed, unpacked
from runtime.standins.faults import NONE
from runtime.standins.websocket_server import Answering, Frames, WebsocketServer

Array = np.ndarray[Any, Any]
Expert = Callable[[str, Array], Array]
"""Function of an instruction and an observation vector [V]: the rows [H, D]. Raises: ValueError."""


class ExpertServer(WebsocketServer):
    """Server that answers each observation with the expert's rows and noise.

    The noise of rows depends on the seed and the observation alone, so that it does not matter in which order, and by
    how many clients, the server is asked.
    """

    says_well = True

    def __init__(
        self, expert: Expert, shape: tuple[int, int], name: str, noise: float, seed: int, port: int
    ) -> None:
        super().__init__("openpi", NONE, port)
        self._expert, (self._observation, self._horizon) = expert, shape
        self._title, self._noise, self._seed = name, noise, seed

    def greeting(self) -> Frames | None:
        """Return the metadata."""
        return packed({"policy": self._title, "action_mode": "absolute", "action_horizon": self._horizon})

    def begin(self) -> Answering:
        """Return the function that answers requests; it keeps nothing between them."""
        return self._reply

    def _reply(self, request: Frames) -> Frames:
        if isinstance(request, str):
            raise TypeError("the request is a text frame; expected a binary one")
        asked = unpacked(request)
        seen = np.asarray(asked["observation/environment_state"], np.float64)
        if seen.shape != (self._observation,):
            raise ValueError(
                f"observation/environment_state has shape {seen.shape}; expected ({self._observation},)"
            )
        return packed({"actions": self.rows(str(asked["prompt"]), seen)})

    def rows(self, instruction: str, seen: Array) -> Array:
        """Return the rows float32 [H, D] for an observation vector [V]."""
        rows = np.asarray(self._expert(instruction, seen.copy()), np.float64)
        chance = np.random.default_rng([self._seed, zlib.crc32(seen.tobytes())])
        return (rows + self._noise * chance.standard_normal(rows.shape)).astype(np.float32)


def serve(expert: Expert, observation: int, horizon: int) -> None:
    """Serve until SIGTERM, SIGINT or the end of the lifeline; `observation` is V, `horizon` is H."""
    line = argparse.ArgumentParser(description=__doc__)
    line.add_argument("--name", default="expert")
    line.add_argument("--noise", type=float, default=0.0, help="one sigma, added to each number of a row")
    line.add_argument("--seed", type=int, default=0, help="of the noise")
    line.add_argument("--port", type=int, default=0)
    program.add_arguments(line)
    options = line.parse_args()
    stop = program.stop_event(options.lifeline)
    server = ExpertServer(
        expert, (observation, horizon), options.name, options.noise, options.seed, options.port
    )
    program.announce_ready(server.start(), options.ready_file)
    stop.wait()
    server.close()
