"""What every middleware has to do, against cyclonedds with its own codec at the other side, over loopback UDP."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.core.errors import TransportError
from runtime.transports.ros import cdr
from runtime.transports.ros.messages import JointState, PoseStamped
from runtime.transports.ros.middleware import COMMAND_QUALITY, SENSOR_QUALITY, Middleware, Quality, Topic
from tests.processes import eventually
from tests.runtime.transports.ros import peer as other
from tests.runtime.transports.ros.peer import BEST_EFFORT, RELIABLE, Peer, joints

Open = Callable[[int], Middleware]
RELIABLE_READER = Quality(reliability="reliable", depth=5)


def dds(domain: int) -> Middleware:
    from runtime.transports.ros.dds_middleware import DdsMiddleware

    return DdsMiddleware(domain, "loopback")


def rclpy(domain: int) -> Middleware:
    from runtime.transports.ros.dds_middleware import configuration
    from runtime.transports.ros.rclpy_middleware import RclMiddleware

    os.environ["CYCLONEDDS_URI"] = configuration("loopback") or ""
    return RclMiddleware(domain, "eva_web_test")


@pytest.fixture(
    params=[
        pytest.param(dds, id="dds"),
        pytest.param(
            rclpy,
            id="rclpy",
            marks=pytest.mark.skipif(
                importlib.util.find_spec("rclpy") is None,
                reason="rclpy, which comes with a ROS 2 installation alone, is absent",
            ),
        ),
    ]
)
def opened(
    request: pytest.FixtureRequest, domain: int, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Middleware]:
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    with contextlib.closing(request.param(domain)) as made:
        yield made


@pytest.fixture
def peer(domain: int) -> Iterator[Peer]:
    with contextlib.closing(Peer(domain)) as made:
        yield made


class Inbox:
    def __init__(self) -> None:
        self.payloads: list[bytes] = []
        self.threads: set[int] = set()

    def __call__(self, payload: bytes) -> None:
        self.payloads.append(payload)
        self.threads.add(threading.get_ident())

    def until(self, count: int = 1) -> list[Any]:
        eventually(lambda: len(self.payloads) >= count, f"{count} messages")
        return [cdr.decode("JointState", payload) for payload in self.payloads]


@pytest.mark.parametrize("policy", [RELIABLE, BEST_EFFORT], ids=["reliable", "best_effort"])
def test_a_best_effort_subscriber_hears_every_publisher(opened: Middleware, peer: Peer, policy: Any) -> None:
    inbox = Inbox()
    opened.subscribe(Topic("/arm/state", "JointState", SENSOR_QUALITY), inbox)
    writer = peer.writer("/arm/state", other.types.JointState, policy)
    peer.matched("/arm/state")
    eventually(lambda: opened.matches()["/arm/state"].peers == 1, "a match on our side")
    for mark in range(5):
        writer.write(joints(["a", "b"], [float(mark), 0.5], 12.25))
        inbox.until(mark + 1)
    first = inbox.until()[0]
    assert (first.stamp, first.names, first.position.tolist()) == (12_250_000_000, ("a", "b"), [0.0, 0.5])
    assert [one.position[0] for one in inbox.until(5)] == [0, 1, 2, 3, 4]
    assert threading.get_ident() not in inbox.threads
    assert opened.matches()["/arm/state"].refused == ""


@pytest.mark.parametrize("policy", [RELIABLE, BEST_EFFORT], ids=["reliable", "best_effort"])
def test_a_reliable_publisher_is_heard_by_every_subscriber(
    opened: Middleware, peer: Peer, policy: Any
) -> None:
    publish = opened.advertise(Topic("/arm/command", "JointState", COMMAND_QUALITY))
    peer.reader("/arm/command", other.types.JointState, policy)
    peer.matched("/arm/command")
    eventually(lambda: opened.matches()["/arm/command"].peers == 1, "a match on our side")
    publish(cdr.encode(JointState(5_000_000_001, "", ("a", "b"), np.array([0.25, -1.5]))))
    heard = peer.heard("/arm/command")[0]
    assert (heard.header.stamp.sec, heard.header.stamp.nanosec) == (5, 1)
    assert (list(heard.name), list(heard.position)) == (["a", "b"], [0.25, -1.5])
    assert (list(heard.velocity), list(heard.effort)) == ([], [])


def test_a_pose_arrives_as_it_was_sent(opened: Middleware, peer: Peer) -> None:
    publish = opened.advertise(Topic("/arm/pose", "PoseStamped", COMMAND_QUALITY))
    peer.reader("/arm/pose", other.types.PoseStamped)
    peer.matched("/arm/pose")
    eventually(lambda: opened.matches()["/arm/pose"].peers == 1, "a match on our side")
    publish(cdr.encode(PoseStamped(7, "base", np.array([1, 2, 3, 0, 0, 0.6, 0.8]))))
    pose = peer.heard("/arm/pose")[0]
    assert pose.header.frame_id == "base"
    assert (pose.pose.position.y, pose.pose.orientation.z, pose.pose.orientation.w) == (2.0, 0.6, 0.8)


def test_a_publisher_whose_quality_does_not_suffice_is_named(opened: Middleware, peer: Peer) -> None:
    opened.subscribe(Topic("/arm/state", "JointState", RELIABLE_READER), Inbox())
    peer.writer("/arm/state", other.types.JointState, BEST_EFFORT)
    eventually(lambda: opened.matches()["/arm/state"].refused, "a refusal")
    match = opened.matches()["/arm/state"]
    assert (
        "a publisher of /arm/state is incompatible in its reliability: we subscribe to it with reliability = "
        "reliable" in match.refused
    )
    assert 'transport.qos."/arm/state".reliability' in match.refused


def test_a_subscriber_who_wants_more_than_is_offered_is_named(opened: Middleware, peer: Peer) -> None:
    best_effort = Quality(reliability="best_effort", depth=1)
    publish = opened.advertise(Topic("/arm/command", "JointState", best_effort))
    peer.reader("/arm/command", other.types.JointState, RELIABLE)
    eventually(lambda: opened.matches()["/arm/command"].refused, "a refusal")
    assert "a subscriber of /arm/command is incompatible in its reliability" in (
        opened.matches()["/arm/command"].refused
    )
    publish(cdr.encode(JointState(1, "", ("a",), np.zeros(1))))  # nobody hears it, and nothing waits


def test_another_type_on_the_topic_is_named(opened: Middleware, peer: Peer) -> None:
    opened.subscribe(Topic("/camera", "CompressedImage", SENSOR_QUALITY), Inbox())
    peer.writer("/camera", other.types.Image, BEST_EFFORT)
    sentence = "/camera is published as sensor_msgs/msg/Image; expected sensor_msgs/msg/CompressedImage"
    eventually(lambda: opened.matches()["/camera"].refused == sentence, sentence)


def test_a_publisher_that_comes_back_is_heard_again(opened: Middleware, domain: int) -> None:
    inbox = Inbox()
    opened.subscribe(Topic("/arm/state", "JointState", SENSOR_QUALITY), inbox)
    for life in (1.0, 2.0):
        with contextlib.closing(Peer(domain)) as peer:
            writer = peer.writer("/arm/state")
            peer.matched("/arm/state")
            eventually(lambda: opened.matches()["/arm/state"].peers >= 1, "a match on our side")

            def came(writer: Any = writer, life: float = life) -> bool:
                writer.write(joints(["a"], [life]))
                return any(one.position[0] == life for one in inbox.until(0))

            eventually(came, f"life {life}")


def test_nothing_is_delivered_once_it_is_closed(opened: Middleware, peer: Peer) -> None:
    inbox = Inbox()
    opened.subscribe(Topic("/arm/state", "JointState", SENSOR_QUALITY), inbox)
    writer = peer.writer("/arm/state")
    peer.matched("/arm/state")
    opened.close()
    opened.close()
    before = len(inbox.payloads)
    for _ in range(5):
        writer.write(joints(["a"], [1.0]))
    eventually(lambda: not writer.get_matched_subscriptions(), "the subscriber to be gone")
    assert len(inbox.payloads) == before


def test_what_fails_on_one_message_does_not_end_the_next(opened: Middleware, peer: Peer) -> None:
    heard: list[bytes] = []

    def stumble(payload: bytes) -> None:
        heard.append(payload)
        if len(heard) == 1:
            raise RuntimeError("on the first one")

    opened.subscribe(Topic("/arm/state", "JointState", SENSOR_QUALITY), stumble)
    writer = peer.writer("/arm/state")
    peer.matched("/arm/state")

    def said() -> bool:
        writer.write(joints(["a"], [1.0]))
        return len(heard) >= 3

    eventually(said, "further messages")


def test_an_interface_that_is_not_there_is_named(domain: int) -> None:
    from runtime.transports.ros.dds_middleware import DdsMiddleware

    with pytest.raises(TransportError, match=r"cannot be joined over 'nosuch0'.*transport\.network"):
        DdsMiddleware(domain, "nosuch0")
    dds(domain).close()  # and the domain is left as it was


def test_a_domain_has_one_network_in_a_process(domain: int) -> None:
    from runtime.transports.ros.dds_middleware import DdsMiddleware

    with (
        contextlib.closing(dds(domain)),
        contextlib.closing(dds(domain)),
        pytest.raises(TransportError, match="in use in this process over another network"),
    ):
        DdsMiddleware(domain, "127.0.0.1")


def test_its_sockets_keep_as_much_as_the_kernel_permits_until_it_is_read(domain: int) -> None:
    permitted = int(Path("/proc/sys/net/core/rmem_max").read_text("ascii"))
    before = set(receive_buffers())
    with contextlib.closing(dds(domain)) as made:
        made.subscribe(Topic("/picture", "Image", SENSOR_QUALITY), Inbox())
        kept = [size for number, size in receive_buffers().items() if number not in before]
    assert 2 * min(16_000_000, permitted) <= max(kept)  # the kernel says twice what it was asked for


def receive_buffers() -> dict[str, int]:
    """Bytes of the receive buffer of each UDP socket of this process, by its name in /proc."""
    sizes = {}
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # none of ours any more, or no socket
            name = os.readlink(link)
            with socket.socket(fileno=os.dup(int(link.name))) as found:
                if name.startswith("socket:") and found.type == socket.SOCK_DGRAM:
                    sizes[name] = found.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    return sizes
