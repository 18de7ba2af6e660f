"""Queries of a page about a target: the pose of the robot there, and whether it can be reached. Nothing moves.

Pages query while an operator drags a slider: the newest query replaces a waiting one, and a page has at most one in
progress. Queries have their own threads and connection to the station, so that no command waits for them.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any
from uuid import uuid4

import numpy as np

from evaweb.accounts.roles import Role
from evaweb.console.requests import Aim
from evaweb.core.binary_frames import to_json_value
from evaweb.core.errors import EvaError
from evaweb.stations.lease_holders import with_display_names
from evaweb.stations.models import Station
from evaweb.stations.request_coalescer import RequestCoalescer, TooManyRequests
from evaweb.stations.robot_geometry import DrawnRobot
from evaweb.stations.runtime_client import StationConnection
from runtime.core.sentences import Pattern, Sentence, identity
from runtime.ipc import messages
from runtime.ipc.bus import CodecError

_VIEWER = Pattern(
    "console.aim.viewer",
    "{user} is a viewer; aiming needs an operator: ask an administrator",
)
_NOT_SENDABLE = Pattern("console.aim.not_sendable", "the target cannot be sent: {error}")


_TIMEOUT_S = 3.0  # the first query may have to wait until the station has loaded its kinematics
_DIGITS = 5  # digits of matrix entries in the answer: 0.01 mm
_under_way: RequestCoalescer[dict[str, Any]] = RequestCoalescer(
    "aim", most=8
)  # limited per station, because a station may hang
SendCallback = Callable[[dict[str, Any]], None]
LinkPosesCallback = Callable[[], DrawnRobot | None]  # returns the robot as currently drawn


class AimQueries:
    """Target queries of one page; for the event loop only."""

    def __init__(
        self, station: Station, username: str, role: Role, say: SendCallback, looks: LinkPosesCallback
    ) -> None:
        self._station, self._username, self._role, self._say = station, username, role, say
        self._looks = looks
        self._waiting: Aim | None = None
        self._under_way = False

    def submit(self, request: Aim) -> bool:
        """Queue a query in place of a waiting one; return True if `answer` has to be started."""
        if self._role is Role.VIEWER:
            self._say({"type": "aimed", "id": request.id, **_refused(_VIEWER(user=self._username))})
            return False
        self._waiting = request
        first, self._under_way = not self._under_way, True
        return first

    async def answer(self) -> None:
        """Answer the newest query until none is waiting; a replaced query gets no answer."""
        try:
            while (request := self._waiting) is not None:
                self._waiting = None
                work = partial(query_aim, self._station.name, self._username, request.args, self._looks())
                result = await self._query(work, request.id)
                self._say({"type": "aimed", "id": request.id, **result})
        finally:
            self._under_way = False

    async def _query(self, work: Callable[[], dict[str, Any]], identity: int) -> dict[str, Any]:
        try:
            answer = _under_way.submit(self._station.name, work, key=id(self), identity=identity)
            return await asyncio.wrap_future(answer)
        except TooManyRequests as fault:
            return _refused(str(fault))


def _refused(reason: str) -> dict[str, Any]:
    """Return the answer that refuses a query for `reason`.

    If `reason` is a translatable sentence, its pattern id and arguments are in the nested `sentence`. They cannot be at
    the top level, where the key "id" is the id of the query.
    """
    fields = {"sentence": identity(reason)} if isinstance(reason, Sentence) else {}
    return {"ok": False, "reason": reason, **fields}


def query_aim(
    station: str, username: str, args: Mapping[str, Any], looks: DrawnRobot | None
) -> dict[str, Any]:
    """Return the station's answer about a target, as JSON.

    The answer also has a key "links" [P * 16]: the poses that the parts of `looks`, the robot as drawn, have at the
    target. The list is empty if the robot is not drawn or the station gave no joints.
    """
    command = messages.Command(str(uuid4()), "aim", args, user=username, holder=username)
    try:
        messages.encode(command)  # an encoding error is the page's fault, not the station's
        ack = _wire_to(station).request(command, timeout=_TIMEOUT_S)
    except CodecError as error:
        return _refused(_NOT_SENDABLE(error=error))
    except EvaError as gone:
        return _refused(str(gone))
    data = to_json_value(dict(ack.data))
    links = _links(looks, data.get("joints")) if ack.status == "done" else []
    outcome = {**_refused(with_display_names(ack.reason)), "ok": ack.status == "done"}
    return {**data, **outcome, "links": links}


def _links(drawn: DrawnRobot | None, joints: Any) -> list[float]:
    """Return the pose of every link at `joints` in the world frame, each matrix in column-major order.

    [] if the robot is not drawn.
    """
    target = np.asarray(joints, np.float64)
    if drawn is None or target.shape != (drawn.robot.dim,):
        return []
    poses: list[float] = drawn.poses(target).astype(np.float64).round(_DIGITS).ravel().tolist()
    return poses if np.isfinite(poses).all() else []


@cache
def _wire_to(name: str) -> StationConnection:
    return StationConnection(name)
