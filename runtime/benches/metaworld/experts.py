"""Meta-World's scripted experts as a policy server of openpi's protocol.

The task is the word of the instruction that is the name of one. The benchmark's own observation vector is in
`observation/environment_state`; the state of a robot alone does not show where the objects are.
"""

from __future__ import annotations

import argparse
import re
import warnings
import zlib
from typing import Any

import numpy as np
from metaworld.policies import ENV_POLICY_MAP  # type: ignore[import-not-found]

from runtime.simulation import program
from runtime.standins.arrays import packed, unpacked
from runtime.standins.faults import NONE
from runtime.standins.websocket_server import Answering, Frames, WebsocketServer

_TASK = re.compile(r"[a-z0-9-]+-v3")


class Experts(WebsocketServer):
    """Server that answers each observation with one row [1, 4], as the task's expert gives it, and noise.

    The noise of a row depends on the seed and the observation alone, so that it does not matter in which order, and by
    how many clients, the server is asked.
    """

    says_well = True

    def __init__(self, name: str, noise: float, seed: int, port: int) -> None:
        super().__init__("openpi", NONE, port)
        self._title, self._noise, self._seed = name, noise, seed
        self._experts: dict[str, Any] = {}

    def greeting(self) -> Frames | None:
        """Return the metadata."""
        return packed({"policy": self._title, "action_mode": "absolute", "action_horizon": 1})

    def begin(self) -> Answering:
        """Return the function that answers requests; it keeps nothing between them."""
        return self._reply

    def _reply(self, request: Frames) -> Frames:
        if isinstance(request, str):
            raise TypeError("the request is a text frame; expected a binary one")
        asked = unpacked(request)
        seen = np.asarray(asked["observation/environment_state"], np.float64)
        if seen.shape != (39,):
            raise ValueError(f"observation/environment_state has shape {seen.shape}; expected (39,)")
        return packed({"actions": self.row(str(asked["prompt"]), seen)[None]})

    def row(self, instruction: str, seen: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Return the row float32 [4] for an observation vector [39]."""
        task = next((word for word in _TASK.findall(instruction) if word in ENV_POLICY_MAP), None)
        if task is None:
            raise ValueError(f"the instruction {instruction!r} names no task of Meta-World, such as reach-v3")
        if task not in self._experts:
            self._experts[task] = ENV_POLICY_MAP[task]()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of rows beyond -1 to 1, which the benchmark cuts
            own = seen.copy()  # some experts write into what they are given
            row = np.asarray(self._experts[task].get_action(own), np.float64)
        chance = np.random.default_rng([self._seed, zlib.crc32(seen.tobytes())])
        return (row + self._noise * chance.standard_normal(4)).astype(np.float32)


def main() -> None:
    """Serve until SIGTERM, SIGINT or the end of the lifeline."""
    line = argparse.ArgumentParser(description=__doc__)
    line.add_argument("--name", default="expert")
    line.add_argument("--noise", type=float, default=0.0, help="one sigma, added to each number of a row")
    line.add_argument("--seed", type=int, default=0, help="of the noise")
    line.add_argument("--port", type=int, default=0)
    program.add_arguments(line)
    options = line.parse_args()
    stop = program.stop_event(options.lifeline)
    server = Experts(options.name, options.noise, options.seed, options.port)
    program.announce_ready(server.start(), options.ready_file)
    stop.wait()
    server.close()


if __name__ == "__main__":
    main()
