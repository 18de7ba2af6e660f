"""Meta-World by itself, without EVA Web, in the benchmark's own environment: success, steps and last observation.

`python metaworld_alone.py TASK,... SEEDS NOISE` prints one JSON line per episode, and the seconds that it took.
"""

import json
import sys
import time
import warnings
import zlib

import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE  # type: ignore[import-not-found]
from metaworld.policies import ENV_POLICY_MAP  # type: ignore[import-not-found]


def run_episode(task: str, seed: int, noise: float) -> dict[str, object]:
    """Run the task's expert until its first success or the benchmark's last step."""
    env = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-goal-observable"](seed=seed)
    env.seeded_rand_vec, env._freeze_rand_vec = True, False
    env.seed(seed)
    seen, _ = env.reset()
    expert, steps, success, over = ENV_POLICY_MAP[task](), 0, False, False
    begun = time.perf_counter()
    while not success and not over:
        row = np.asarray(expert.get_action(seen.copy()), np.float64)
        chance = np.random.default_rng([0, zlib.crc32(seen.tobytes())])
        row = (row + noise * chance.standard_normal(4)).astype(np.float32)
        seen, _, terminated, truncated, info = env.step(row)
        steps, success, over = steps + 1, bool(info["success"]), bool(terminated or truncated)
    took = time.perf_counter() - begun
    end = {"success": success, "steps": steps, "last": seen.tolist()}
    return {"task": task, "seed": seed, **end, "seconds": took}


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # of experts' rows beyond -1 to 1, which the benchmark cuts
    tasks, seeds, noise = sys.argv[1:]
    for task in tasks.split(","):
        for seed in range(int(seeds)):
            print(json.dumps(run_episode(task, seed, float(noise))), flush=True)
