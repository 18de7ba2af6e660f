"""Peers on a real socket that do what a test says, and observations of one arm."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

import robots
from robots import Robot
from runtime.core import msgpack_arrays
from runtime.core.types import Observation

FRANKA = robots.load_robot(
    "dual_franka", ["left_arm"]
)  # the arm of DROID: seven joints and a gripper, 1 is open
PIPER = robots.load_robot("agilex_piper")
Handler = Callable[[ServerConnection], None]


def seen(robot: Robot, value: float = 0.1, **changes: Any) -> Observation:
    """An observation with every joint at `value`, camera n all of grey n, and poses of those joints."""
    pictures = {
        camera.key: np.full((48, 64, 3), index, np.uint8) for index, camera in enumerate(robot.cameras)
    }
    qpos = np.full(robot.dim, value, np.float32)
    arms = [np.append(arm.pose(qpos.astype(np.float64)), value) for arm in robot.arms]
    made = Observation(
        sequence=1,
        arrived=0.0,
        captured={},
        qpos=qpos,
        eef=np.concatenate(arms).astype(np.float32),
        pictures=pictures,
        prompt="pick the block",
    )
    return dataclasses.replace(made, **changes)


@contextlib.contextmanager
def serving(handler: Handler) -> Iterator[str]:
    """A websocket server whose every conversation is `handler`; its address."""

    def converse(connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            handler(connection)

    with serve(converse, "127.0.0.1", 0, compression=None, max_size=None, close_timeout=0.5) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


def answering(metadata: object, answer: Callable[[Any], object], asked: list[bytes] | None = None) -> Handler:
    """Sends `metadata`, then for each request what `answer` makes of it: text and bytes as they are, else packed."""

    def converse(connection: ServerConnection) -> None:
        connection.send(_frame(metadata))
        for request in connection:
            assert isinstance(request, bytes)
            if asked is not None:
                asked.append(request)
            connection.send(_frame(answer(msgpack_arrays.unpack(request))))

    return converse


def _frame(value: object) -> str | bytes:
    return value if isinstance(value, str | bytes) else msgpack_arrays.pack(value)
