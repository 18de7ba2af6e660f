"""Meta-World as a bench: the benchmark's own environments, step by step."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE  # type: ignore[import-not-found]

from runtime.benches.interface import Moment, Refusal

_CAMERAS = {"cam_corner": "corner2", "cam_gripper": "gripperPOV"}
_COSTLY = (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION)


class MetaWorld:
    """One task at a time; an episode ends with its first success, or after the benchmark's own 500 steps."""

    dim, observation = 4, 39
    milestones = ("success",)
    cameras = tuple(_CAMERAS)

    def __init__(self) -> None:
        self._env: Any = None
        self._task, self._plain = "", False
        self._renderer: mujoco.Renderer | None = None
        self._size = (0, 0)

    def reset(self, seed: int, choices: Mapping[str, str]) -> Moment:
        """Begin the episode of a task that this seed decides, as `env.seed(seed)` before `env.reset()` does."""
        task, self._plain = choices["task"], choices["pictures"] == "plain"
        make = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE.get(f"{task}-goal-observable")
        if make is None:
            raise Refusal(f"task = {task!r}: Meta-World has no such task")
        # Anew for each episode: nothing of an earlier one can be left.
        self._close()
        self._env, self._task = make(seed=seed), task
        self._env.seeded_rand_vec = True
        self._env._freeze_rand_vec = False
        self._env.seed(seed)
        seen, _ = self._env.reset()
        return self._moment(seen, success=False)

    def step(self, row: np.ndarray[Any, Any]) -> Moment:
        """Execute one row [4]; the benchmark cuts it to -1 to 1."""
        seen, _, terminated, truncated, info = self._env.step(row)
        success = bool(info["success"])
        over = "success" if success else ""
        if not success and (terminated or truncated):
            over = f"the benchmark's {self._env.max_path_length} steps"
        return self._moment(seen, success=success, over=over)

    def observe(self, width: int, height: int) -> dict[str, np.ndarray[Any, Any]]:
        """Return the pictures, RGB uint8 [height, width, 3]; the corner's is turned upright, as LeRobot turns it."""
        if self._renderer is None or self._size != (width, height):
            self._free_renderer()
            if self._plain:
                self._env.model.vis.quality.offsamples = 0
            self._renderer, self._size = mujoco.Renderer(self._env.model, height, width), (width, height)
        pictures = {}
        for key, camera in _CAMERAS.items():
            self._renderer.update_scene(self._env.data, camera)
            if self._plain:
                for flag in _COSTLY:
                    self._renderer.scene.flags[flag] = False
            picture = self._renderer.render()
            pictures[key] = picture[::-1, ::-1] if key == "cam_corner" else picture
        return pictures

    def _moment(self, seen: np.ndarray[Any, Any], *, success: bool, over: str = "") -> Moment:
        return Moment(
            np.asarray(seen[:4], np.float32), np.asarray(seen, np.float64), {"success": success}, over
        )

    def _close(self) -> None:
        self._free_renderer()
        if self._env is not None:
            self._env.close()
        self._env = None

    def _free_renderer(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None


def make_bench() -> MetaWorld:
    """Return the bench, which has no task before its first reset."""
    if os.environ.get("MUJOCO_GL") not in ("egl", "osmesa"):
        raise SystemExit("MUJOCO_GL: allowed: egl, osmesa")
    return MetaWorld()
