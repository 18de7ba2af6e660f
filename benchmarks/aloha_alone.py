"""gym-aloha by itself, without EVA Web, in the benchmark's own environment: success, steps and last observation.

`python aloha_alone.py TASK,... SEEDS URL` prints one JSON line per episode, and the seconds that it took. Rows are
those of the openpi server at URL. The images that the benchmark draws in each step are left out: no number depends on
them.
"""

import json
import sys
import time

import gym_aloha  # type: ignore[import-not-found]  # noqa: F401 - registers its environments
import gymnasium  # type: ignore[import-not-found]
import msgpack  # type: ignore[import-untyped]
import numpy as np
from websockets.sync.client import connect

NAMES = {"transfer_cube": "gym_aloha/AlohaTransferCube-v0", "insertion": "gym_aloha/AlohaInsertion-v0"}


def request_rows(url: str, seen: np.ndarray) -> np.ndarray:
    """Return the rows [300, 14] of the server for an observation vector."""
    array = {b"__ndarray__": True, b"data": seen.tobytes(), b"dtype": seen.dtype.str, b"shape": seen.shape}
    with connect(url) as server:
        server.recv()  # its metadata
        server.send(msgpack.packb({"prompt": "", "observation/environment_state": array}))
        rows = msgpack.unpackb(server.recv())["actions"]
    return np.frombuffer(rows[b"data"], rows[b"dtype"]).reshape(rows[b"shape"])


def run_episode(task: str, seed: int, url: str) -> dict[str, object]:
    """Run the rows of the server until the benchmark's end."""
    env = gymnasium.make(NAMES[task])
    core = env.unwrapped._env
    core.physics.render = lambda **_: np.zeros((480, 640, 3), np.uint8)

    def read_observation() -> np.ndarray:
        objects = core.task.get_env_state(core.physics)
        return np.concatenate([core.task.get_qpos(core.physics), objects, np.zeros(14 - len(objects))])

    env.reset(seed=seed)
    rows, steps, success, over = request_rows(url, read_observation()), 0, False, False
    begun = time.perf_counter()
    while not over:
        _, _, success, truncated, _ = env.step(rows[steps])
        steps, over = steps + 1, bool(success or truncated)
    took = time.perf_counter() - begun
    end = {"success": bool(success), "steps": steps, "last": read_observation().tolist()}
    return {"task": task, "seed": seed, **end, "seconds": took}


if __name__ == "__main__":
    tasks, seeds, address = sys.argv[1:]
    for name in tasks.split(","):
        for number in range(int(seeds)):
            print(json.dumps(run_episode(name, number, address)), flush=True)
