"""ROS 1 node for a process that cannot run rospy itself: `PYTHON THIS_FILE OPTIONS`, run by its path.

It runs in any Python that has rospy, so it uses only the standard library (Python 3.8 and later) and ROS, and is never
imported. Messages pass in their encoded form. The protocol of the two sockets is described in
runtime/transports/ros/rospy_process.py. The node lives until its parent closes them, or until the master changes.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import socket
import struct
import sys
import tempfile
import threading
import time
import xmlrpc.client
from typing import Any

MESSAGE, WORD = 1, 2
HEAD = struct.Struct("<BxHI")  # kind, topic, size
COMMAND = struct.Struct("<BxHd")  # kind, topic, creation time on the machine's monotonic clock [s]
LARGEST_COMMAND = 1 << 20
ANSWER_S = 2.0  # timeout of the master and of other nodes [s]
LOOK_S, MASTER_S, WHY_S = 0.2, 1.0, 2.0  # periods [s]: peers reported, master polled, missing peers explained
LEAVE_S = 1.0
LONGEST_SAYING, SAYINGS_KEPT = 300, 100
BUFFER = {"Image": 1 << 24, "CompressedImage": 1 << 22}
BUFFER_OF_NUMBERS = 1 << 18
LOGGING = "version: 1\ndisable_existing_loggers: false\n"


class NoXmlRpcAnswer(Exception):
    """Error for a peer that does not answer like a ROS master or node."""


class _Bounded(xmlrpc.client.Transport):
    """HTTP transport with a timeout."""

    def make_connection(self, host: Any) -> Any:
        connection = super().make_connection(host)
        connection.timeout = ANSWER_S
        return connection


def call_xmlrpc(address: str, method: str, *arguments: Any, default: Any = None) -> Any:
    """Call a method of the master or a node and return its result.

    If the call reports failure, return `default`, or raise NoXmlRpcAnswer without a `default`. Raises NoXmlRpcAnswer if
    there is no answer.
    """
    try:
        with xmlrpc.client.ServerProxy(address, transport=_Bounded()) as proxy:
            code, message, value = getattr(proxy, method)("/eva_web", *arguments)
    except OSError as error:
        raise NoXmlRpcAnswer(error.strerror or str(error) or type(error).__name__) from error
    except Exception as error:
        raise NoXmlRpcAnswer(f"not a ROS master: {type(error).__name__}: {str(error)[:200]}") from error
    if code == 1:
        return value
    if default is None:
        raise NoXmlRpcAnswer(message)
    return default


class Parent:
    """Link to the parent process. Messages stay whole although several threads send."""

    def __init__(self, telling: socket.socket, commands: socket.socket) -> None:
        self._telling, self.commands = telling, commands
        self._lock = threading.Lock()

    def message(self, index: int, payload: bytes) -> None:
        """Send a message; block while the parent is slow, so that no messages accumulate here."""
        self._send(HEAD.pack(MESSAGE, index, len(payload)), payload)

    def send_word(self, **fields: Any) -> None:
        payload = json.dumps(fields).encode()
        self._send(HEAD.pack(WORD, 0, len(payload)), payload)

    def _send(self, head: bytes, payload: bytes) -> None:
        with self._lock:
            try:
                sent = self._telling.sendmsg([head, payload])
                if sent < len(head) + len(payload):
                    self._telling.sendall((head + payload)[sent:])
            except OSError:  # the parent has ended, so this process has no purpose
                os._exit(0)


class WarningForwarder(logging.Handler):
    """Log handler that forwards rospy's warnings to the parent, each text once."""

    def __init__(self, parent: Parent) -> None:
        super().__init__(logging.WARNING)
        self._parent, self._said = parent, set()  # type: ignore[var-annotated]

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage().strip().splitlines()
        line = (text[-1] if "Traceback" in " ".join(text) else " ".join(text))[:LONGEST_SAYING]
        if line and line not in self._said and len(self._said) < SAYINGS_KEPT:
            self._said.add(line)
            self._parent.send_word(log=line)


class Topics:
    """Subscribed and advertised topics, numbered as by the parent."""

    def __init__(self, parent: Parent) -> None:
        self._parent = parent
        self.open: dict[int, tuple[str, Any, Any]] = {}  # name, message class, Subscriber or Publisher
        self._counts: dict[int, int] = {}
        self.stale = 0  # number of commands that were too old to be published

    def subscribe(self, index: int, name: str, kind: str, queue: int) -> None:
        import rospy

        message_class, size = raw(kind), BUFFER.get(kind.rpartition("/")[2], BUFFER_OF_NUMBERS)
        self.open[index] = (name, message_class, None)
        subscriber = rospy.Subscriber(
            name, message_class, lambda message: self._parent.message(index, message._buff),
            queue_size=queue, buff_size=size, tcp_nodelay=True,
        )  # fmt: skip
        self.open[index] = (name, message_class, subscriber)

    def advertise(self, index: int, name: str, kind: str, queue: int) -> None:
        import rospy

        message_class = raw(kind)
        self.open[index] = (
            name,
            message_class,
            rospy.Publisher(name, message_class, queue_size=queue, tcp_nodelay=True),
        )
        self._counts[index] = 0

    def publish(self, index: int, payload: bytes) -> None:
        """Publish a message, with the next sequence number of the topic in its header, as rospy would number it."""
        self._counts[index] = (self._counts[index] + 1) % (1 << 32)
        _, message_class, publisher = self.open[index]
        message = message_class()
        message._buff = struct.pack("<I", self._counts[index]) + payload[4:]
        publisher.publish(message)

    def publishes(self, index: int) -> bool:
        return index in self._counts

    def peers(self, index: int) -> int:
        """Return the number of connected peers; refused peers and those that are still connecting do not count."""
        opened = self.open[index][2]
        if opened is None:
            return 0
        connections = list(opened.impl.connections)
        return sum(
            1
            for connection in connections
            if self.publishes(index) or (connection.socket is not None and connection.md5sum)
        )


def raw(kind: str) -> Any:
    """Return a rospy message class whose messages stay encoded, with the type and checksum of `kind`."""
    import importlib

    import rospy

    package, _, name = kind.partition("/")
    real = getattr(importlib.import_module(f"{package}.msg"), name)
    fields = {"_type": kind, "_md5sum": real._md5sum, "_full_text": real._full_text}
    return type(name, (rospy.AnyMsg,), fields)


class PeerMonitor:
    """Monitor that reports the peers of each topic to the parent and ends the process when the master changes."""

    def __init__(self, parent: Parent, topics: Topics, master: str, address: str) -> None:
        import rospy

        self._parent, self._topics, self._master, self._address = parent, topics, master, address
        self._name = rospy.get_name()
        self._uri = call_xmlrpc(master, "lookupNode", self._name)
        self._identity = self._who()
        self._trouble = ""
        self._refused: dict[int, str] = {}
        self._told: dict[str, Any] = {}

    def run(self) -> None:
        look_at = why_at = 0.0
        while True:
            now = time.monotonic()
            if now >= look_at:
                look_at = now + MASTER_S
                self._poll()
            if now >= why_at:
                why_at = now + WHY_S
                self._explain()
            self._report_changes()
            time.sleep(LOOK_S)

    def _who(self) -> list[Any]:
        return [
            call_xmlrpc(self._master, "getParam", "/run_id", default=""),
            call_xmlrpc(self._master, "getPid"),
        ]

    def _poll(self) -> None:
        try:
            identity, uri = self._who(), call_xmlrpc(self._master, "lookupNode", self._name, default="")
        except NoXmlRpcAnswer as error:
            self._trouble = f"the ROS master at {self._master} does not answer: {error}"
            return
        self._trouble = ""
        if identity != self._identity or uri != self._uri:
            self._parent.send_word(
                anew=f"the ROS master at {self._master} is another than before, and does not know us"
            )
            os._exit(0)

    def _explain(self) -> None:
        """Find out why topics have no connected peer although the master lists nodes for them.

        For each such topic the first of these nodes is examined, and the reason is stored by topic.
        """
        lonely = [index for index in list(self._topics.open) if not self._topics.peers(index)]
        self._refused = {}
        if not lonely or self._trouble:
            return
        with contextlib.suppress(NoXmlRpcAnswer):  # the next round reports it
            publishers, subscribers, _ = call_xmlrpc(self._master, "getSystemState")
            for index in lonely:
                spoken = self._topics.publishes(index)
                name = self._topics.open[index][0]
                peers = [
                    n for t, nodes in (subscribers if spoken else publishers) if t == name for n in nodes
                ]
                peers = [node for node in peers if node != self._name]
                if peers:
                    self._refused[index] = self._absence(index, peers[0], spoken)

    def _absence(self, index: int, node: str, spoken: bool) -> str:
        """Return why `node`, which the master lists for the topic, is not connected to this process.

        `spoken`: this process publishes the topic, so that the node is a subscriber; otherwise the node is a publisher.
        """
        name, message_class, _ = self._topics.open[index]
        verb = "subscribes to" if spoken else "publishes"
        try:
            uri = call_xmlrpc(self._master, "lookupNode", node)
        except NoXmlRpcAnswer as error:
            return f"the master says that {node} {verb} {name}, and not where that is: {error}"
        try:
            reply = call_xmlrpc(uri, "getSubscriptions" if spoken else "getPublications")
        except NoXmlRpcAnswer as error:
            return (
                f"{node}, which {verb} {name}, is not to be reached at {uri}: {error}; does it still run, and is its "
                "ROS_IP or ROS_HOSTNAME an address that is known here?"
            )
        kinds = [kind for topic, kind in reply if topic == name]
        if kinds and kinds[0] not in (message_class._type, "*"):
            participle = "subscribed to" if spoken else "published"
            return f"{name} is {participle} as {kinds[0]} by {node}; expected {message_class._type}"
        if not kinds:
            return f"the master says that {node} {verb} {name}, but {node} does not any more"
        return (
            f"{node} {verb} {name} and is not connected; it has to reach {self._address} (transport.address), and to "
            f"have the same definition of {message_class._type}"
        )

    def _report_changes(self) -> None:
        """Report the status to the parent if it has changed."""
        counts = {
            str(index): [self._topics.peers(index), self._refused.get(index, "")]
            for index in list(self._topics.open)
        }
        status = {"peers": counts, "trouble": self._trouble, "stale": self._topics.stale}
        if status != self._told:
            self._told = status
            self._parent.send_word(**status)


def run_commands(parent: Parent, topics: Topics, life: float) -> None:
    """Execute the parent's requests until it has ended; commands older than `life` [s] are dropped."""
    while True:
        packet = parent.commands.recv(LARGEST_COMMAND)
        if not packet:
            return
        if packet[0] == WORD:
            request = json.loads(packet[1:])
            act = topics.advertise if request.pop("publish") else topics.subscribe
            try:
                act(**request)
            except Exception as error:  # exceptions of rospy for a bad name or definition
                parent.send_word(unopened=[request["index"], f"{request['name']} cannot be opened: {error}"])
            continue
        _, index, created = COMMAND.unpack_from(packet)
        if time.monotonic() - created > life:
            topics.stale += 1
        elif index in topics.open:
            topics.publish(index, packet[COMMAND.size :])


def start_node(options: dict[str, Any], parent: Parent) -> None:
    """Start the node; report the failure to the parent and end the process if that is impossible."""
    master = options["master"]
    try:
        call_xmlrpc(master, "getPid")  # init_node would wait for a master for ever
    except NoXmlRpcAnswer as error:
        parent.send_word(failed=str(error))
        sys.exit(1)
    import rospy

    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "logging.yaml")
        with open(path, "w") as file:
            file.write(LOGGING)
        os.environ.update(ROS_PYTHON_LOG_CONFIG_FILE=path, ROS_LOG_DIR=folder)
        rospy.init_node(
            options["name"], argv=[], disable_signals=True, disable_rostime=True, disable_rosout=True
        )
    for name in ("rospy", "rosout"):
        logging.getLogger(name).addHandler(WarningForwarder(parent))


def shut_down() -> None:
    """Deregister from the master and end the process, even if the master does not answer."""
    import rospy

    ending = threading.Thread(target=rospy.signal_shutdown, args=("the parent has ended",), daemon=True)
    ending.start()
    ending.join(LEAVE_S)
    os._exit(0)


def main() -> None:
    """Run as a child of the parent process; with the option "check", only test the imports."""
    for kind in ("sensor_msgs/JointState", "geometry_msgs/PoseStamped"):
        raw(kind)
    options = json.loads(sys.argv[1])
    if options.get("check"):
        return
    for number in (signal.SIGINT, signal.SIGTERM):  # the parent decides when this process ends
        signal.signal(number, signal.SIG_IGN)
    parent = Parent(socket.socket(fileno=options["telling"]), socket.socket(fileno=options["commands"]))
    start_node(options, parent)
    topics = Topics(parent)
    try:
        watch = PeerMonitor(parent, topics, options["master"], options["address"])
    except NoXmlRpcAnswer as error:
        parent.send_word(failed=str(error))
        os._exit(1)
    parent.send_word(ready=True)
    threading.Thread(target=watch.run, name="watch", daemon=True).start()
    run_commands(parent, topics, options["life"])
    shut_down()


if __name__ == "__main__":
    main()
