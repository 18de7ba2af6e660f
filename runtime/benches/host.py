"""Host of a bench's own program: `python -m runtime.benches.host FILE ADDRESS`, started by the station.

It runs in the bench's environment, which needs numpy, pyzmq and msgpack, loads the Python file, and answers requests:
`ready`, `describe`, `reset`, `step` and `observe`. The file has a function `make_bench` that returns a `Bench`.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
import threading
import traceback
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import zmq

from runtime.benches.interface import Bench, Moment, Refusal
from runtime.core import msgpack_arrays
from runtime.core.errors import CodecError

PROTOCOL = 1
_LONGEST = 500  # characters of what a person reads: the station drops a ground truth that is too long


class Host:
    """Answers to requests about one bench."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._steps = 0
        self._over = "it has not been reset"

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return the answer to a request; a refusal has the key `error`."""
        try:
            return self._answer(request)
        except Refusal as refusal:
            return {"error": str(refusal)[:_LONGEST]}
        except Exception as error:  # of code that is not ours: the station says it, and the trial fails
            traceback.print_exc()
            return {"error": f"{type(error).__name__}: {error}"[:_LONGEST]}

    def _answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        word, bench = request.get("do"), self._bench
        if word == "ready":
            return {}
        if word == "describe":
            numbers = {"dim": bench.dim, "observation": bench.observation}
            names = {"milestones": list(bench.milestones), "cameras": list(bench.cameras)}
            return {"protocol": PROTOCOL, **numbers, **names}
        if word == "reset":
            self._over = "its last reset failed"  # until this one has succeeded
            moment = bench.reset(int(request["seed"]), dict(request["choices"]))
            self._steps = 0
            return self._encode_moment(moment)
        if word == "step":
            if self._over:
                raise Refusal(f"no step is possible: {self._over}")
            moment = bench.step(np.array(request["row"], np.float32))
            self._steps += 1
            return self._encode_moment(moment)
        if word == "observe":
            size = int(request["width"]), int(request["height"])
            drawn = bench.observe(*size)
            return {"pictures": {key: np.ascontiguousarray(picture) for key, picture in drawn.items()}}
        raise Refusal(f"request {word!r}; allowed: ready, describe, reset, step, observe")

    def _encode_moment(self, moment: Moment) -> dict[str, Any]:
        self._over = moment.over
        return {
            "state": np.ascontiguousarray(moment.state, np.float32),
            **(
                {}
                if moment.observation is None
                else {"observation": np.ascontiguousarray(moment.observation, np.float64)}
            ),
            "milestones": {name: bool(reached) for name, reached in moment.milestones.items()},
            "over": moment.over[:_LONGEST] if isinstance(moment.over, str) else moment.over,
            "steps": self._steps,
        }


def load_bench(file: str) -> Bench:
    """Return what `make_bench` of a Python file returns."""
    sys.path.insert(0, os.path.dirname(os.path.abspath(file)))
    spec = importlib.util.spec_from_file_location("bench_program", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench_program"] = module
    spec.loader.exec_module(module)
    bench: Bench = module.make_bench()
    return bench


def main(arguments: Sequence[str]) -> int:
    """Answer requests until standard input ends."""
    file, address = arguments
    threading.Thread(target=_end_with_input, args=[address], name="lifeline", daemon=True).start()
    host = Host(load_bench(file))
    context: zmq.Context[Any] = zmq.Context.instance()
    socket = context.socket(zmq.REP)
    socket.bind(address)
    while True:
        try:
            request = msgpack_arrays.unpack(socket.recv())
        except CodecError as error:
            socket.send(msgpack_arrays.pack({"error": str(error)}))
            continue
        socket.send(msgpack_arrays.pack(host.answer(request)))


def _end_with_input(address: str) -> None:
    """End this process at once when standard input ends: the station is gone, and cannot remove the socket's folder."""
    while os.read(0, 4096):
        pass
    file = address.removeprefix("ipc://")
    with contextlib.suppress(OSError):  # the station has removed it, or it is not there yet
        os.unlink(file)
    with contextlib.suppress(OSError):  # the program has left something in it
        os.rmdir(os.path.dirname(file))
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
