"""ROS 1 topics through rospy in a child process, which is restarted when it ends or the master is replaced.

A restarted master knows no nodes, and ROS 1 nodes do not register again by themselves. A new child therefore registers
anew; other nodes that are older than the master must be restarted, too. If there is no master yet, the middleware waits
for it and reports that it waits.
"""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Mapping
from typing import Any

from runtime.core.errors import RuntimeFault
from runtime.transports.ros.messages import PACKAGES
from runtime.transports.ros.middleware import Deliver, Match, Middleware, Publish, Topic
from runtime.transports.ros.rospy_process import RosEnvironment, RospyProcess, require

log = logging.getLogger(__name__)
_PAUSES_S = (0.2, 0.5, 1.0, 2.0)  # pauses between attempts to start it again [s]; the last one repeats


class TcpRosMiddleware(Middleware):
    """Middleware with one rospy node at a time; one thread reads from the node and replaces it when it ends."""

    def __init__(self, site: RosEnvironment, name: str) -> None:
        """Start a node in the background as soon as the master answers. Raises SetupError without rospy."""
        require(site.python)
        self._site, self._name = site, name
        self._topics: list[tuple[Topic, Deliver | None]] = []  # None: a command topic
        self._peers: dict[int, tuple[int, str]] = {}
        self._unopened: dict[int, str] = {}
        self._trouble = ""  # reason why there is no child or no master
        self._farewell = ""  # reason why the child ended
        self._stale = self._lost = 0
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._child: RospyProcess | None = None
        self._thread = threading.Thread(target=self._run, name="rospy", daemon=True)
        self._thread.start()

    def subscribe(self, topic: Topic, deliver: Deliver) -> None:
        """Subscribe to the topic; `deliver` is called from the middleware's one thread."""
        self._open(topic, deliver)

    def advertise(self, topic: Topic) -> Publish:
        """Return a publisher on the topic.

        It drops commands while the child is absent or does not read, because they would be old when they are sent.
        """
        index = self._open(topic, None)

        def publish(payload: bytes) -> None:
            child = self._child
            if child is None or not child.publish(index, payload):
                self._lost += 1
                if self._lost.bit_count() == 1:  # at 1, 2, 4, 8, ...
                    log.warning(
                        "commands did not leave, %d so far: %s", self._lost, self._trouble or "behind"
                    )

        return publish

    def matches(self) -> Mapping[str, Match]:
        """Return for each topic the number of peers that the child last reported.

        If a topic has no peer, the reason is included as far as it is known.
        """
        with self._lock:
            matches = {}
            for index, (topic, _) in enumerate(self._topics):
                peers, refused = self._peers.get(index, (0, ""))
                reason = "" if peers else self._unopened.get(index) or self._trouble or refused
                matches[topic.name] = Match(peers, reason)
            return matches

    @property
    def pid(self) -> int | None:
        """Process id of rospy; None while there is no child."""
        child = self._child
        return None if child is None else child.pid

    def close(self) -> None:
        """End the child, then the thread."""
        self._ending.set()
        child = self._child
        if child is not None:
            child.interrupt()
        self._thread.join()

    def _open(self, topic: Topic, deliver: Deliver | None) -> int:
        with self._lock:
            self._topics.append((topic, deliver))
            index = len(self._topics) - 1
            if self._child is not None:
                self._request(self._child, index)
            return index

    def _request(self, child: RospyProcess, index: int) -> None:
        topic, deliver = self._topics[index]
        kind = f"{PACKAGES[topic.message]}/{topic.message}"
        child.request(
            publish=deliver is None, index=index, name=topic.name, kind=kind, queue=topic.quality.depth or 1
        )

    def _start(self) -> RospyProcess:
        # A master ends the first node when a second one registers under the same name.
        return RospyProcess(self._site, f"{self._name}_{uuid.uuid4().hex[:12]}")

    def _run(self) -> None:
        """Run the thread: read from a child until it ends, then from the next one."""
        child = self._start_child(0.0)
        while child is not None:
            self._farewell = ""
            child.read_messages(self._deliver, self._handle_word)
            with self._lock:
                self._child = None
                self._peers = {}
            code = child.stop()
            if self._ending.is_set():
                return
            self._complain(self._farewell or f"the process of rospy has ended ({code}); starting it again")
            child = self._start_child(_PAUSES_S[0])

    def _start_child(self, pause: float) -> RospyProcess | None:
        """Start a child that opens all topics, and return it; None if the middleware is being closed.

        The first attempt is made after `pause` [s]. Attempts are repeated, with pauses between them, until one
        succeeds.
        """
        later = iter(_PAUSES_S)
        while not self._ending.wait(pause):
            pause = next(later, _PAUSES_S[-1])
            try:
                child = self._start()
            except RuntimeFault as error:
                self._complain(str(error))
                continue
            with self._lock:
                self._trouble, self._stale, self._unopened = "", 0, {}
                self._child = child
                for index in range(len(self._topics)):
                    self._request(child, index)
            if self._ending.is_set():  # `close` ran before it could see this child
                child.interrupt()
            log.info("rospy is a node of the master at %s", self._site.master)
            return child
        return None

    def _complain(self, sentence: str) -> None:
        if sentence != self._trouble:
            log.warning("%s", sentence)
        self._trouble = sentence

    def _deliver(self, index: int, payload: bytes) -> None:
        deliver = self._topics[index][1]
        if deliver is None or self._ending.is_set():
            return
        try:
            deliver(payload)
        except Exception:  # an error with one message must not end the only reader
            log.exception("reading %s failed", self._topics[index][0].name)

    def _handle_word(self, word: dict[str, Any]) -> None:
        """Store or log what a control word of the child reports.

        That is the status of its peers, a warning of rospy, a topic that it could not open, or the reason why it ends
        and must be started again.
        """
        if "peers" in word:
            self._take_status(word)
        elif "log" in word:
            log.warning("rospy: %s", word["log"])
        elif "unopened" in word:
            index, sentence = word["unopened"]
            log.error("%s", sentence)
            with self._lock:
                self._unopened[index] = sentence
        elif "anew" in word:
            self._farewell = f"{word['anew']}; starting rospy again"

    def _take_status(self, word: dict[str, Any]) -> None:
        with self._lock:
            self._peers = {int(index): (peers, refused) for index, (peers, refused) in word["peers"].items()}
        if word["trouble"] != self._trouble:
            self._trouble = word["trouble"]
            if self._trouble:
                log.warning("%s; existing connections continue, new nodes are not found", self._trouble)
            else:
                log.info("the ROS master at %s answers again", self._site.master)
        if word["stale"] > self._stale:
            self._stale = word["stale"]
            log.warning("%d commands were too old to be published", self._stale)
