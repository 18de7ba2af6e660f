"""ROS 1's middleware against rospy with its own messages at the other side, over a real master and TCP."""

from __future__ import annotations

import ast
import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.core.errors import SetupError, TransportError
from runtime.transports.ros import ros1_serialization, rospy_process
from runtime.transports.ros.messages import JointState, MessageName, PoseStamped
from runtime.transports.ros.middleware import COMMAND_QUALITY, SENSOR_QUALITY, Topic
from runtime.transports.ros.rospy_middleware import TcpRosMiddleware
from runtime.transports.ros.rospy_process import RosEnvironment, RospyProcess, require
from tests.processes import PATIENCE_S, alive, eventually, joined
from tests.runtime.ros_master import PYTHON, RosMaster, master, needs_ros1
from tests.runtime.transports.ros.ros1_peer import Peer

JOINTS, IMAGE, COMPRESSED = "sensor_msgs/JointState", "sensor_msgs/Image", "sensor_msgs/CompressedImage"


def site(master: RosMaster) -> RosEnvironment:
    return RosEnvironment(PYTHON, master.uri, "127.0.0.1")


@pytest.fixture
def opened(ros_master: RosMaster) -> Iterator[TcpRosMiddleware]:
    with contextlib.closing(TcpRosMiddleware(site(ros_master), "eva_test")) as made:
        yield made


@pytest.fixture
def peer(ros_master: RosMaster) -> Iterator[Peer]:
    with contextlib.closing(Peer(PYTHON, ros_master.environment)) as made:
        yield made


class Inbox:
    def __init__(self, name: MessageName = "JointState") -> None:
        self.name, self.payloads = name, []  # type: ignore[var-annotated]
        self.threads: set[int] = set()

    def __call__(self, payload: bytes) -> None:
        self.payloads.append(payload)
        self.threads.add(threading.get_ident())

    def until(self, count: int = 1) -> list[Any]:
        eventually(lambda: len(self.payloads) >= count, f"{count} messages")
        return [ros1_serialization.decode(self.name, payload) for payload in self.payloads]


def heard(middleware: TcpRosMiddleware, topic: str, inbox: Inbox, kind: MessageName = "JointState") -> Inbox:
    middleware.subscribe(Topic(topic, kind, SENSOR_QUALITY), inbox)
    return inbox


def matched(middleware: TcpRosMiddleware, topic: str) -> None:
    try:
        eventually(lambda: middleware.matches()[topic].peers == 1, f"a match on {topic}")
    except AssertionError as error:
        raise AssertionError(f"{error}: {middleware.matches()}") from error


def say(peer: Peer, topic: str, mark: float, stamp: int = 10**12) -> None:
    peer.publish(topic, JOINTS, name=["a", "b"], position=[mark, 0.5], stamp=stamp)


@needs_ros1
def test_a_publishers_messages_come_in_order_from_another_thread(
    opened: TcpRosMiddleware, peer: Peer
) -> None:
    inbox = heard(opened, "/order/state", Inbox())
    say(peer, "/order/state", -1.0)  # it is advertised with its first message
    matched(opened, "/order/state")
    inbox.payloads.clear()
    for mark in range(5):
        say(peer, "/order/state", float(mark), 12_250_000_000)
        inbox.until(mark + 1)
    first = inbox.until()[0]
    assert (first.stamp, first.names, first.position.tolist()) == (12_250_000_000, ("a", "b"), [0.0, 0.5])
    assert [one.position[0] for one in inbox.until(5)] == [0, 1, 2, 3, 4]
    assert threading.get_ident() not in inbox.threads
    assert opened.matches()["/order/state"].refused == ""


@needs_ros1
def test_a_picture_of_a_megabyte_comes_whole(opened: TcpRosMiddleware, peer: Peer) -> None:
    inbox = heard(opened, "/camera/raw", Inbox("Image"), "Image")
    fields = {"height": 480, "width": 640, "step": 1920, "encoding": "rgb8", "fill": 7, "size": 480 * 1920}
    peer.publish("/camera/raw", IMAGE, **fields)
    matched(opened, "/camera/raw")
    inbox.payloads.clear()
    for _ in range(5):
        peer.publish("/camera/raw", IMAGE, **fields)
    for image in inbox.until(5):
        assert (image.height, image.width, image.encoding, len(image.data)) == (480, 640, "rgb8", 480 * 1920)
        assert (image.data == 7).all()


@needs_ros1
def test_a_compressed_picture_comes_whole(opened: TcpRosMiddleware, peer: Peer) -> None:
    inbox = heard(opened, "/camera/compressed", Inbox("CompressedImage"), "CompressedImage")

    def came() -> bool:
        peer.publish("/camera/compressed", COMPRESSED, format="jpeg", fill=3, size=40_000)
        return bool(inbox.payloads)

    eventually(came, "a picture")
    (image, *_) = inbox.until()
    assert (image.format, len(image.data), set(image.data.tolist())) == ("jpeg", 40_000, {3})


@needs_ros1
def test_commands_arrive_counted_and_as_they_were(opened: TcpRosMiddleware, peer: Peer) -> None:
    publish = opened.advertise(Topic("/arm/command", "JointState", COMMAND_QUALITY))
    pose = opened.advertise(Topic("/arm/pose", "PoseStamped", COMMAND_QUALITY))
    peer.listen("/arm/command", JOINTS)
    peer.listen("/arm/pose", "geometry_msgs/PoseStamped")
    matched(opened, "/arm/command")
    matched(opened, "/arm/pose")
    for mark in range(3):
        publish(ros1_serialization.encode(JointState(5_000_000_001, "", ("a", "b"), np.array([mark, -1.5]))))
        eventually(lambda: len(peer.heard["/arm/command"]) > mark, "the command")  # noqa: B023
    first = peer.heard["/arm/command"][0]
    assert (first["stamp"], first["names"], first["position"]) == (5_000_000_001, ["a", "b"], [0.0, -1.5])
    assert first["velocity"] == []
    assert [one["seq"] for one in peer.heard["/arm/command"]] == [1, 2, 3]
    pose(ros1_serialization.encode(PoseStamped(7, "base", np.array([1, 2, 3, 0, 0, 0.6, 0.8]))))
    eventually(lambda: peer.heard["/arm/pose"], "the pose")
    assert peer.heard["/arm/pose"][0]["frame"] == "base"
    assert peer.heard["/arm/pose"][0]["pose"] == [1, 2, 3, 0, 0, 0.6, 0.8]


@needs_ros1
def test_another_type_on_a_topic_is_named_both_ways(opened: TcpRosMiddleware, peer: Peer) -> None:
    heard(opened, "/camera", Inbox(), "CompressedImage")
    peer.publish("/camera", IMAGE, fill=0, size=3)
    sentence = "/camera is published as sensor_msgs/Image by /test_peer; expected sensor_msgs/CompressedImage"
    eventually(lambda: opened.matches()["/camera"].refused == sentence, sentence)
    opened.advertise(Topic("/goal", "PoseStamped", COMMAND_QUALITY))
    peer.listen("/goal", JOINTS)
    sentence = (
        "/goal is subscribed to as sensor_msgs/JointState by /test_peer; expected geometry_msgs/PoseStamped"
    )
    eventually(lambda: opened.matches()["/goal"].refused == sentence, sentence)
    assert opened.matches()["/goal"].peers == 0


@needs_ros1
def test_a_publisher_that_was_killed_and_comes_back_is_heard_again(
    opened: TcpRosMiddleware, ros_master: RosMaster
) -> None:
    inbox = heard(opened, "/lives/state", Inbox())
    for life in (1.0, 2.0):
        peer = Peer(PYTHON, ros_master.environment)

        def came(peer: Peer = peer, life: float = life) -> bool:
            say(peer, "/lives/state", life)
            return any(one.position[0] == life for one in inbox.until(0))

        eventually(came, f"life {life}")
        peer.kill()
        eventually(lambda: opened.matches()["/lives/state"].peers == 0, "its end")
    sentence = "/test_peer, which publishes /lives/state, is not to be reached at http://127.0.0.1:"
    eventually(lambda: sentence in opened.matches()["/lives/state"].refused, sentence)


@needs_ros1
def test_nothing_is_delivered_once_it_is_closed_and_no_process_is_left(
    opened: TcpRosMiddleware, peer: Peer
) -> None:
    inbox = heard(opened, "/closed/state", Inbox())
    say(peer, "/closed/state", 0.0)
    matched(opened, "/closed/state")
    pid = opened.pid
    assert pid is not None
    opened.close()
    opened.close()
    before = len(inbox.payloads)
    for _ in range(5):
        say(peer, "/closed/state", 1.0)
    assert not alive(pid)
    assert opened.pid is None
    assert len(inbox.payloads) == before


@needs_ros1
def test_what_fails_on_one_message_does_not_end_the_next(opened: TcpRosMiddleware, peer: Peer) -> None:
    heard: list[bytes] = []

    def stumble(payload: bytes) -> None:
        heard.append(payload)
        if len(heard) == 1:
            raise RuntimeError("on the first one")

    opened.subscribe(Topic("/stumble", "JointState", SENSOR_QUALITY), stumble)

    def said() -> bool:
        say(peer, "/stumble", 1.0)
        return len(heard) >= 3

    eventually(said, "further messages")


@needs_ros1
def test_rospys_process_that_dies_is_started_again(
    opened: TcpRosMiddleware, peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    inbox = heard(opened, "/death/state", Inbox())
    publish = opened.advertise(Topic("/death/command", "JointState", COMMAND_QUALITY))
    peer.listen("/death/command", JOINTS)
    say(peer, "/death/state", 0.0)
    matched(opened, "/death/state")
    matched(opened, "/death/command")
    first = opened.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    eventually(lambda: opened.pid not in (None, first), "another process")
    inbox.payloads.clear()

    def both() -> bool:
        say(peer, "/death/state", 1.0)
        publish(ros1_serialization.encode(JointState(1, "", ("again",), np.zeros(1))))
        return bool(inbox.payloads) and any("again" in one["names"] for one in peer.heard["/death/command"])

    eventually(both, "messages both ways")
    assert "the process of rospy has ended (-9); starting it again" in caplog.messages


@needs_ros1
def test_commands_that_waited_too_long_are_not_published(
    opened: TcpRosMiddleware, peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    publish = opened.advertise(Topic("/late/command", "JointState", COMMAND_QUALITY))
    peer.listen("/late/command", JOINTS)
    matched(opened, "/late/command")
    assert opened.pid is not None
    os.kill(opened.pid, signal.SIGSTOP)
    try:
        for _ in range(5):
            publish(ros1_serialization.encode(JointState(1, "", ("old",), np.zeros(1))))
        time.sleep(0.5)  # longer than a command lives
        for _ in range(3000):  # more than the way there holds: sending waits for nobody
            publish(ros1_serialization.encode(JointState(1, "", ("old",), np.zeros(1))))
        assert any("commands did not leave" in message for message in caplog.messages)
        time.sleep(0.5)
    finally:
        os.kill(opened.pid, signal.SIGCONT)

    def fresh() -> bool:
        publish(ros1_serialization.encode(JointState(1, "", ("new",), np.zeros(1))))
        return any("new" in one["names"] for one in peer.heard["/late/command"])

    eventually(fresh, "a command of now")
    assert not [one for one in peer.heard["/late/command"] if "old" in one["names"]]
    eventually(lambda: any("too old to be published" in message for message in caplog.messages), "a word")


@needs_ros1
def test_it_ends_with_the_process_that_it_works_for(ros_master: RosMaster) -> None:
    code = (
        "import time\n"
        "from runtime.transports.ros.rospy_process import RosEnvironment\n"
        "from runtime.transports.ros.rospy_middleware import TcpRosMiddleware\n"
        f"made = TcpRosMiddleware(RosEnvironment({PYTHON!r}, {ros_master.uri!r}, '127.0.0.1'), 'eva_test')\n"
        "while made.pid is None: time.sleep(0.05)\n"
        "print(made.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    owner = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert owner.stdout is not None
    pid = int(owner.stdout.readline())
    assert alive(pid)
    owner.kill()
    owner.wait(PATIENCE_S)
    owner.stdout.close()
    eventually(lambda: not alive(pid), "the end of its rospy")


@pytest.mark.exhaustive
@needs_ros1
@pytest.mark.slow
def test_a_master_that_dies_and_comes_back_is_registered_with_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with master(tmp_path, whole=True) as ros, contextlib.ExitStack() as held:
        made = held.enter_context(contextlib.closing(TcpRosMiddleware(site(ros), "eva_test")))
        peer = held.enter_context(contextlib.closing(Peer(PYTHON, ros.environment)))
        inbox = heard(made, "/master/state", Inbox())
        say(peer, "/master/state", 0.0)
        matched(made, "/master/state")
        ros.kill()
        eventually(
            lambda: any("connections continue" in text for text in caplog.messages), "the master's end"
        )
        inbox.payloads.clear()
        say(peer, "/master/state", 1.0)  # what is connected goes on
        assert inbox.until()[0].position[0] == 1.0
        first = made.pid
        ros.start()
        eventually(lambda: made.pid not in (None, first), "a new registration")
        later = held.enter_context(contextlib.closing(Peer(PYTHON, ros.environment)))

        def came() -> bool:
            say(later, "/master/state", 2.0)
            return any(one.position[0] == 2.0 for one in inbox.until(0))

        eventually(came, "a node of the new master")
    said = f"the ROS master at {ros.uri} is another than before, and does not know us; starting rospy again"
    assert said in caplog.messages


@needs_ros1
def test_a_master_that_is_not_there_is_named() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        uri = f"http://127.0.0.1:{probe.getsockname()[1]}"
    with pytest.raises(
        TransportError,
        match=rf"no ROS master is to be reached at {uri}: Connection refused; start roscore there, or say in "
        r"transport\.master where it is",
    ):
        RospyProcess(RosEnvironment(PYTHON, uri, "127.0.0.1"), "eva_test")


@needs_ros1
def test_a_master_that_starts_later_is_waited_for_and_named_meanwhile(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    ros = RosMaster(tmp_path)
    with contextlib.closing(TcpRosMiddleware(site(ros), "eva_test")) as made, contextlib.closing(ros):
        inbox = heard(made, "/later/state", Inbox())
        sentence = f"no ROS master is to be reached at {ros.uri}: "
        eventually(lambda: sentence in made.matches()["/later/state"].refused, sentence)
        ros.start()
        with contextlib.closing(Peer(PYTHON, ros.environment)) as peer:

            def came() -> bool:
                say(peer, "/later/state", 1.0)
                return bool(inbox.payloads)

            eventually(came, "a message")
    said = [text for text in caplog.messages if "no ROS master" in text]
    assert len(said) == 1  # however often it was looked for


@needs_ros1
@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (b"HTTP/1.0 404 Not Found\r\n\r\n", "not a ROS master: ProtocolError"),
        (b"nonsense\r\n", "not a ROS master: BadStatusLine"),
        (b"", "Remote end closed connection without response"),
    ],
)
def test_what_is_no_master_is_named(answer: bytes, said: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            for _ in range(2):  # xmlrpc asks again where a connection was closed
                with contextlib.suppress(OSError), server.accept()[0] as caller:
                    caller.recv(4096)
                    caller.sendall(answer)
                    caller.shutdown(socket.SHUT_WR)
                    while caller.recv(4096):  # closed over what was not read, it would be a reset
                        pass

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        uri = f"http://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(TransportError, match=f"no ROS master is to be reached at {uri}: {said}"):
            RospyProcess(RosEnvironment(PYTHON, uri, "127.0.0.1"), "eva_test")
        server.shutdown(
            socket.SHUT_RDWR
        )  # or it would wait on, and take who comes to the next one of this number
        joined(thread)


@needs_ros1
def test_a_master_that_is_mute_is_named_within_seconds() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        uri = f"http://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(TransportError, match=f"no ROS master is to be reached at {uri}: timed out"):
            RospyProcess(RosEnvironment(PYTHON, uri, "127.0.0.1"), "eva_test")


def test_a_python_that_is_not_there_is_named() -> None:
    with pytest.raises(
        SetupError, match=r"transport\.python = '/no/python' cannot be run: .*apt-get install"
    ):
        require("/no/python")


def test_a_python_without_rospy_says_what_to_install() -> None:
    with pytest.raises(
        SetupError,
        match=r"ROS 1 needs rospy, which .* \(transport\.python\) lacks: ModuleNotFoundError: No module named "
        r"'rospy'; install it \(Debian: apt-get install python3-rospy python3-sensor-msgs\), or name",
    ):
        require(sys.executable)


def test_rospys_environment_is_the_deployments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_HOSTNAME", "elsewhere")
    monkeypatch.setenv("ROS_NAMESPACE", "/other")
    monkeypatch.setenv("ROS_MASTER_URI", "http://other:1")
    made = RosEnvironment(PYTHON, "http://127.0.0.1:5", "127.0.0.1").environment
    assert (made["ROS_MASTER_URI"], made["ROS_IP"]) == ("http://127.0.0.1:5", "127.0.0.1")
    assert not {"ROS_HOSTNAME", "ROS_NAMESPACE"} & made.keys()


def test_the_program_for_the_other_python_knows_the_standard_library_alone() -> None:
    code = (
        f"import sys, runpy; runpy.run_path({str(rospy_process._PROGRAM)!r}, run_name='seen'); "
        "print([m for m in sys.modules if m.partition('.')[0] in ('numpy', 'pydantic', 'runtime')])"
    )
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    ast.parse(rospy_process._PROGRAM.read_text("utf-8"), feature_version=(3, 8))  # Noetic's
