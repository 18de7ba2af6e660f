"""The other side of a ROS 1 topic in the hands of a test: rospy with its own messages, in a process of its own.

Run by its path it is that process: it takes one order per line of standard input, and prints what it hears.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

_NODE = "test_peer"


class Peer:
    """A node with publishers and subscribers by topic; `close` ends it with leave, `kill` without."""

    def __init__(self, python: str, environment: dict[str, str]) -> None:
        self._process = subprocess.Popen(
            [python, str(Path(__file__))],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True,
        )  # fmt: skip
        self.heard: dict[str, list[dict[str, Any]]] = {}
        assert self._process.stdout is not None
        assert json.loads(self._process.stdout.readline()) == {"ready": True}
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def publish(self, topic: str, kind: str, **fields: Any) -> None:
        """One message of numbers, words and lists; a picture's `data` is so many bytes of `fill`."""
        self._order(publish=topic, kind=kind, fields=fields)

    def listen(self, topic: str, kind: str) -> None:
        self.heard[topic] = []
        self._order(listen=topic, kind=kind)

    def kill(self) -> None:
        self._process.kill()
        self._end()

    def close(self) -> None:
        assert self._process.stdin is not None
        if not self._process.stdin.closed:
            self._process.stdin.close()
            self._end()

    def _end(self) -> None:
        from tests.processes import (
            PATIENCE_S,  # ROS's Python, which runs this file too, knows nothing of ours
        )

        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.wait(PATIENCE_S)
        self._thread.join()
        self._process.stdout.close()
        if not self._process.stdin.closed:
            self._process.stdin.close()

    def _order(self, **order: Any) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            said = json.loads(line)
            self.heard[said["topic"]].append(said)


def main() -> None:
    """The process: Debian's Python, rospy and its messages."""
    import importlib
    import os

    import rospy

    def kind_of(name: str) -> Any:
        package, _, kind = name.partition("/")
        return getattr(importlib.import_module(f"{package}.msg"), kind)

    def teller(topic: str) -> Callable[[Any], None]:
        def tell(message: Any) -> None:
            said = {"topic": topic, "seq": message.header.seq, "stamp": message.header.stamp.to_nsec()}
            said["frame"] = message.header.frame_id
            if hasattr(message, "pose"):
                p, o = message.pose.position, message.pose.orientation
                said["pose"] = [p.x, p.y, p.z, o.x, o.y, o.z, o.w]
            else:
                said |= {"names": message.name, "position": message.position, "velocity": message.velocity}
            print(json.dumps(said), flush=True)

        return tell

    rospy.init_node(_NODE, disable_signals=True)
    publishers: dict[str, Any] = {}
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        order = json.loads(line)
        kind = kind_of(order["kind"])
        if "listen" in order:
            rospy.Subscriber(order["listen"], kind, teller(order["listen"]))
            continue
        topic, fields = order["publish"], order["fields"]
        if topic not in publishers:
            publishers[topic] = rospy.Publisher(topic, kind, queue_size=10)
        message = kind()
        message.header.stamp = rospy.Time(*divmod(fields.pop("stamp", 10**12), 10**9))
        if "fill" in fields:
            message.data = bytes([fields.pop("fill")]) * fields.pop("size")
        for name, value in fields.items():
            setattr(message, name, value)
        publishers[topic].publish(message)
    ending = threading.Thread(target=rospy.signal_shutdown, args=("the end",), daemon=True)
    ending.start()
    ending.join(2.0)
    os._exit(0)


if __name__ == "__main__":
    main()
