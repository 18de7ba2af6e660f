"""gym-aloha as a bench: the benchmark's own environments, step by step."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import gym_aloha  # type: ignore[import-not-found]  # noqa: F401 - registers its environments
import gymnasium  # type: ignore[import-not-found]
import mujoco
import numpy as np

from runtime.benches.interface import Moment, Refusal

_TASKS = {"transfer_cube": "gym_aloha/AlohaTransferCube-v0", "insertion": "gym_aloha/AlohaInsertion-v0"}
_REWARDS = ("touched", "lifted", "met", "done")  # from 1 on
_OBJECTS = 14  # numbers of two poses
_COSTLY = (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION)


class Aloha:
    """One task at a time; an episode ends with its success, or after the benchmark's own 300 steps."""

    dim, observation = 14, 14 + _OBJECTS
    milestones = _REWARDS
    cameras = ("cam_top",)

    def __init__(self) -> None:
        self._env: Any = None
        self._core: Any = None  # dm_control's environment in it
        self._reached: dict[str, bool] = {}
        self._is_plain = False
        self._renderer: mujoco.Renderer | None = None
        self._size = (0, 0)

    def reset(self, seed: int, choices: Mapping[str, str]) -> Moment:
        """Begin the episode of a task that this seed decides, as the benchmark's `reset(seed=seed)` does."""
        if choices["task"] not in _TASKS:
            raise Refusal(f"task = {choices['task']!r}; allowed: {', '.join(_TASKS)}")
        self._close()  # anew for each episode: nothing of an earlier one can be left
        self._is_plain = choices["pictures"] == "plain"
        self._env = gymnasium.make(_TASKS[choices["task"]], disable_env_checker=True)
        self._core = self._env.unwrapped._env
        self._reached = dict.fromkeys(_REWARDS, False)
        # The benchmark draws three images of 640x480 in each step, most of its time; ours are drawn when asked.
        self._core.task.get_observation = lambda physics: {"images": {"top": np.empty(0)}}
        self._env.reset(seed=seed)
        return self._moment()

    def step(self, row: np.ndarray[Any, Any]) -> Moment:
        """Execute one row [14]: absolute joints [rad], grippers from 0 (closed) to 1 (open)."""
        _, reward, terminated, truncated, _ = self._env.step(row)
        for name in _REWARDS[
            : int(reward)
        ]:  # as ACT, whose tasks these are, counts: the highest reward decides
            self._reached[name] = True
        over = "success" if terminated else f"the benchmark's {self._env.spec.max_episode_steps} steps"
        return self._moment(over if terminated or truncated else "")

    def observe(self, width: int, height: int) -> dict[str, np.ndarray[Any, Any]]:
        """Return the picture from above, RGB uint8 [height, width, 3]."""
        model, data = self._core.physics.model.ptr, self._core.physics.data.ptr
        if self._renderer is None or self._size != (width, height):
            self._free_renderer()
            model.vis.global_.offwidth, model.vis.global_.offheight = width, height
            if self._is_plain:
                model.vis.quality.offsamples = 0
            self._renderer, self._size = mujoco.Renderer(model, height, width), (width, height)
        self._renderer.update_scene(data, "top")
        if self._is_plain:
            for flag in _COSTLY:
                self._renderer.scene.flags[flag] = False
        return {"cam_top": self._renderer.render()}

    def _moment(self, over: str = "") -> Moment:
        task, physics = self._core.task, self._core.physics
        joints, objects = task.get_qpos(physics), task.get_env_state(physics)
        seen = np.concatenate([joints, objects, np.zeros(_OBJECTS - len(objects))])
        return Moment(np.asarray(joints, np.float32), seen, dict(self._reached), over)

    def _close(self) -> None:
        self._free_renderer()
        if self._env is not None:
            self._env.close()
        self._env = None

    def _free_renderer(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None


def make_bench() -> Aloha:
    """Return the bench, which has no task before its first reset."""
    if os.environ.get("MUJOCO_GL") not in ("egl", "osmesa"):
        raise SystemExit("MUJOCO_GL: allowed: egl, osmesa")
    return Aloha()
