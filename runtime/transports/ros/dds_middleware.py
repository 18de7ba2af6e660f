"""ROS 2 topics over DDS without a ROS installation; needs the package cyclonedds.

Names, types and quality of service follow ROS 2's own middlewares (design.ros2.org, "Topic and Service name mapping
to DDS"): topic /a/b is rt/a/b, its type sensor_msgs::msg::dds_::JointState_, its encoding XCDR1, and its type hash
part of the user data.
"""

from __future__ import annotations

import importlib
import logging
import threading
from collections.abc import Mapping
from typing import Any

from runtime.core.errors import SetupError, TransportError
from runtime.transports.ros.messages import PACKAGES
from runtime.transports.ros.middleware import (
    COMMAND_LIFE_S,
    Deliver,
    Match,
    Middleware,
    Publish,
    Topic,
    describe_incompatible,
)

log = logging.getLogger(__name__)
LOOPBACK, ENVIRONMENT = "loopback", "environment"
_WAKE_NS = 100_000_000  # time until the reader thread notices that it must end [ns]
_TAKEN = 64
_RECEIVED = "16MB"  # kernel buffer, if permitted: three raw pictures exceed the usual 1 MB
_MOST_ENDPOINTS = 2000
_POLICIES = {
    2: "durability", 4: "deadline", 5: "latency_budget", 6: "ownership", 8: "liveliness", 10: "partition",
    11: "reliability", 12: "destination_order", 23: "data_representation", 24: "type_consistency",
}  # fmt: skip


def configuration(network: str, peers: tuple[str, ...] = ()) -> str | None:
    """Return Cyclone's configuration for a network interface (name or address); None if $CYCLONEDDS_URI is to apply.

    `peers` are addresses of participants that multicast does not reach. On loopback they are not used: because it has
    no multicast, participants find each other by address, at the first 30 ports of the domain. This finds Fast DDS
    nodes, and nodes of Cyclone DDS 0.10 (Jazzy) and 11 with the same configuration.
    """
    from xml.sax.saxutils import quoteattr  # imported here: it also imports HTTP and TLS

    if network == ENVIRONMENT:
        return None
    local = network == LOOPBACK
    interface = 'name="lo" multicast="false"' if local else _interface(network)
    addresses = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in (("127.0.0.1",) if local else peers))
    return (
        "<CycloneDDS><Domain><General>"
        f"<Interfaces><NetworkInterface {interface}/></Interfaces>"
        + ("<AllowMulticast>false</AllowMulticast>" if local else "")
        + "</General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
        "<MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>"
        + (f"<Peers>{addresses}</Peers>" if addresses else "")
        + f'</Discovery><Internal><SocketReceiveBufferSize max="{_RECEIVED}"/></Internal></Domain></CycloneDDS>'
    )


def _interface(network: str) -> str:
    from xml.sax.saxutils import quoteattr

    kind = "address" if network.replace(".", "").isdigit() or ":" in network else "name"
    return f"{kind}={quoteattr(network)}"


class _Domains:
    """DDS domains that this process has joined; each has one configuration and exists while it has users."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: dict[int, tuple[Any, str | None, int]] = {}

    def enter(self, number: int, configured: str | None) -> None:
        from cyclonedds.domain import Domain

        with self._lock:
            domain, before, users = self._open.get(number, (None, configured, 0))
            if before != configured:
                raise TransportError(f"DDS domain {number} is in use in this process over another network")
            if users == 0 and configured is not None:
                domain = Domain(number, configured)
            self._open[number] = (domain, configured, users + 1)

    def leave(self, number: int) -> None:
        with self._lock:
            domain, configured, users = self._open.pop(number)
            if users > 1:
                self._open[number] = (domain, configured, users - 1)


_domains = _Domains()  # state: the library has one of each per process, whoever made it


class DdsMiddleware(Middleware):
    """DDS participant, with one thread that waits for messages of all its readers."""

    def __init__(self, domain: int, network: str, peers: tuple[str, ...] = ()) -> None:
        """Join the domain. Raises SetupError without the package, TransportError if the network cannot be used."""
        require()
        from cyclonedds.core import DDSException, WaitSet
        from cyclonedds.domain import DomainParticipant
        from cyclonedds.qos import Policy, Qos

        self._domain = domain
        self._entered = False
        try:
            _domains.enter(domain, configuration(network, peers))
            self._entered = True
            self._participant: Any = DomainParticipant(domain, Qos(Policy.Userdata(b"enclave=/;")))
            self._waitset: Any = WaitSet(self._participant)
        except DDSException as error:
            self._leave()
            raise TransportError(
                f"DDS domain {domain} cannot be joined over {network!r}: {error}; is there such an interface "
                "(transport.network), and has the domain less than 30 participants on this machine?"
            ) from error
        self._readers: list[tuple[Topic, Any, Deliver]] = []
        self._writers: list[tuple[Topic, Any]] = []
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def subscribe(self, topic: Topic, deliver: Deliver) -> None:
        """Subscribe to the topic; `deliver` is called from the middleware's one thread."""
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader

        reader = self._create_endpoint(DataReader, topic, life=False)
        condition = ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any)
        with self._lock:
            self._readers.append((topic, reader, deliver))
        self._waitset.attach(condition)
        if self._thread is None:
            self._thread = threading.Thread(target=self._read, name="dds", daemon=True)
            self._thread.start()

    def advertise(self, topic: Topic) -> Publish:
        """Return a publisher on the topic, which drops a message rather than wait for a slow reader."""
        from cyclonedds.core import DDSException
        from cyclonedds.pub import DataWriter

        from runtime.transports.ros.idl import TYPES

        writer = self._create_endpoint(DataWriter, topic, life=True)
        kind = TYPES[topic.message]
        self._writers.append((topic, writer))

        def publish(payload: bytes) -> None:
            try:
                writer.write(kind(payload))
            except DDSException as error:
                if (
                    error.code != DDSException.DDS_RETCODE_TIMEOUT
                ):  # a reader is behind; the next command follows
                    raise TransportError(f"{topic.name} cannot be published: {error}") from error

        return publish

    def matches(self) -> Mapping[str, Match]:
        """Return for each topic the number of connected peers, and the reason if a further peer was refused.

        Both are from DDS's own status. If a topic has no peer, the discovery data are searched for peers with another
        message type. A refusal is reported for the rest of the middleware's life, because DDS only counts refusals.
        """
        from cyclonedds.core import DDSException

        with self._lock:
            readers = [(topic, reader) for topic, reader, _ in self._readers]
        matches: dict[str, Match] = {}
        try:
            for topic, reader in readers:
                peers = len(reader.get_matched_publications())
                status = reader.get_requested_incompatible_qos_status()
                matches[topic.name] = Match(peers, self._refused(topic, status, peers, False))
            for topic, writer in self._writers:
                peers = len(writer.get_matched_subscriptions())
                status = writer.get_offered_incompatible_qos_status()
                matches[topic.name] = Match(peers, self._refused(topic, status, peers, True))
        except DDSException as error:
            raise TransportError(f"DDS does not say who is at the other side: {error}") from error
        return matches

    def close(self) -> None:
        """End the thread, then the participant with all its readers and writers."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        for entity in (*(r for _, r, _ in self._readers), *(w for _, w in self._writers), self._participant):
            if entity is not None:
                entity.__del__()  # now, in spite of other references; a second call is harmless
        self._readers, self._writers = [], []
        self._waitset = self._participant = None
        self._leave()

    def _leave(self) -> None:
        if self._entered:
            self._entered = False
            _domains.leave(self._domain)

    def _create_endpoint(self, kind: Any, topic: Topic, life: bool) -> Any:
        """Create a reader or a writer of the topic; `kind` is the class of the endpoint.

        If `life` is True, messages that are older than the lifetime of commands are not delivered. Raises
        TransportError if the topic cannot be opened.
        """
        from cyclonedds.core import DDSException
        from cyclonedds.topic import Topic as DdsTopic

        from runtime.transports.ros.idl import TYPES

        try:
            channel = DdsTopic(self._participant, f"rt{topic.name}", TYPES[topic.message])
            return kind(self._participant, channel, _quality(topic, life))
        except DDSException as error:
            raise TransportError(f"{topic.name} cannot be opened: {error}") from error

    def _read(self) -> None:
        """Run the reader thread; an error in one message does not end it."""
        while not self._ending.is_set():
            try:
                self._waitset.wait(_WAKE_NS)
                with self._lock:
                    readers = list(self._readers)
                for topic, reader, deliver in readers:
                    self._hand_over(topic, reader, deliver)
            except Exception:
                log.exception("reading from DDS failed")
                self._ending.wait(0.1)

    def _hand_over(self, topic: Topic, reader: Any, deliver: Deliver) -> None:
        for sample in reader.take(_TAKEN):
            payload = getattr(sample, "payload", None)  # absent in the notice of a publisher that has left
            if payload is not None and sample.sample_info.valid_data:
                deliver(payload)

    def _refused(self, topic: Topic, status: Any, peers: int, publishes: bool) -> str:
        """Return why a peer of the topic was refused, "" if no peer was."""
        mismatch = "" if peers else self._otherwise_typed(topic, publishes)
        if mismatch or not status.total_count:
            return mismatch
        return describe_incompatible(
            topic, _POLICIES.get(status.last_policy_id, f"policy {status.last_policy_id}"), publishes
        )

    def _otherwise_typed(self, topic: Topic, publishes: bool) -> str:
        """Return a sentence about a peer with another message type, "" if there is none; DDS itself does not report it.

        If `publishes`, such a peer is a subscriber, otherwise a publisher.
        """
        from cyclonedds.builtin import (
            BuiltinDataReader,
            BuiltinTopicDcpsPublication,
            BuiltinTopicDcpsSubscription,
        )

        peer_topic = BuiltinTopicDcpsSubscription if publishes else BuiltinTopicDcpsPublication
        type_name = _type_name(topic)
        for endpoint in BuiltinDataReader(self._participant, peer_topic).read(_MOST_ENDPOINTS):
            kind = getattr(endpoint, "type_name", type_name)  # absent for an endpoint that has left
            if kind != type_name and endpoint.topic_name == f"rt{topic.name}":
                verb = "subscribed to" if publishes else "published"
                return f"{topic.name} is {verb} as {_ros_name(kind)}; expected {_ros_name(type_name)}"
        return ""


def require() -> None:
    """Raise SetupError with an instruction unless the package cyclonedds is installed in the needed version."""
    try:
        importlib.import_module("runtime.transports.ros.idl")
    except ImportError as error:
        raise SetupError(
            f'transport.middleware = "dds" needs the package cyclonedds ({error}); '
            'install it: pip install "eva-web[ros2]"'
        ) from error


def _type_name(topic: Topic) -> str:
    return f"{PACKAGES[topic.message]}::msg::dds_::{topic.message}_"


def _ros_name(kind: str) -> str:
    return kind.replace("::dds_::", "::").removesuffix("_").replace("::", "/")


def _quality(topic: Topic, life: bool) -> Any:
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.util import duration

    from runtime.transports.ros.idl import HASHES

    requested = topic.quality
    reliable = requested.reliability == "reliable"
    policies = [
        Policy.Reliability.Reliable(duration(milliseconds=1)) if reliable else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(requested.depth),
        Policy.Durability.TransientLocal
        if requested.durability == "transient_local"
        else Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f"typehash={HASHES[topic.message]};".encode()),
    ]
    if life:
        policies.append(Policy.Lifespan(duration(seconds=COMMAND_LIFE_S)))
    return Qos(*policies)
