"""ROS 2 topics through rclpy, if a ROS 2 installation provides it for this Python.

Messages pass as bytes in both directions, as over plain DDS, so that no field is converted in Python.
"""

from __future__ import annotations

import importlib
import logging
import sys
import threading
from collections.abc import Mapping
from typing import Any

from runtime.core.errors import SetupError, TransportError
from runtime.transports.ros.messages import PACKAGES
from runtime.transports.ros.middleware import (
    Deliver,
    Match,
    Middleware,
    Publish,
    Topic,
    describe_incompatible,
)

log = logging.getLogger(__name__)


def require() -> None:
    """Raise SetupError with an instruction unless this Python can import rclpy."""
    try:
        for name in ("rclpy", *(f"{package}.msg" for package in set(PACKAGES.values()))):
            importlib.import_module(name)
    except ImportError as error:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise SetupError(
            f'transport.middleware = "rclpy" needs a ROS 2 installation for Python {version} ({error}); source its '
            'setup.bash, or use middleware = "dds", which needs none'
        ) from error


class RclMiddleware(Middleware):
    """ROS 2 node in a context of its own, which does not disturb other nodes of the process; one thread spins it."""

    def __init__(self, domain: int, name: str) -> None:
        """Join the domain. Raises SetupError without rclpy, TransportError if it cannot start."""
        require()
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self._context: Any = rclpy.Context()
        try:
            rclpy.init(args=[], context=self._context, domain_id=domain)
            self._node: Any = rclpy.create_node(name, context=self._context, use_global_arguments=False)
        except Exception as error:  # rclpy raises exceptions of its C layer
            self._context.try_shutdown()
            raise TransportError(f"ROS domain {domain} cannot be joined: {error}") from error
        self._executor: Any = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._subscribed: dict[str, Topic] = {}
        self._advertised: dict[str, tuple[Topic, Any]] = {}
        self._refused: dict[str, str] = {}
        self._ending = threading.Event()
        self._thread: threading.Thread | None = threading.Thread(target=self._spin, name="rclpy", daemon=True)
        self._thread.start()

    def subscribe(self, topic: Topic, deliver: Deliver) -> None:
        """Subscribe to the topic; `deliver` receives the raw bytes from the executor's thread."""
        events, _ = _events()
        callbacks = events(incompatible_qos=lambda event: self._note(topic, event, publishes=False))
        self._node.create_subscription(
            _kind(topic), topic.name, deliver, _quality(topic, False), raw=True, event_callbacks=callbacks
        )
        self._subscribed[topic.name] = topic

    def advertise(self, topic: Topic) -> Publish:
        """Return a publisher of bytes on the topic."""
        _, events = _events()
        callbacks = events(incompatible_qos=lambda event: self._note(topic, event, publishes=True))
        publisher = self._node.create_publisher(
            _kind(topic), topic.name, _quality(topic, True), event_callbacks=callbacks
        )
        self._advertised[topic.name] = (topic, publisher)

        def publish(payload: bytes) -> None:
            try:
                publisher.publish(payload)
            except Exception as error:
                raise TransportError(f"{topic.name} cannot be published: {error}") from error

        return publish

    def matches(self) -> Mapping[str, Match]:
        """Return for each topic the number of peers in the ROS graph, and the reason if a peer was refused.

        A reason is, for example, another message type.
        """
        matches = {}
        for name, topic in self._subscribed.items():
            expected = f"{PACKAGES[topic.message]}/msg/{topic.message}"
            kinds = [endpoint.topic_type for endpoint in self._node.get_publishers_info_by_topic(name)]
            mismatched = [kind for kind in kinds if kind != expected]
            refused = self._refused.get(name, "")
            if mismatched and expected not in kinds:
                refused = refused or f"{name} is published as {mismatched[0]}; expected {expected}"
            matches[name] = Match(kinds.count(expected), refused)
        for name, (_, publisher) in self._advertised.items():
            matches[name] = Match(publisher.get_subscription_count(), self._refused.get(name, ""))
        return matches

    def close(self) -> None:
        """End the thread, the node and its context."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            self._executor.shutdown()
            self._node.destroy_node()
            self._context.try_shutdown()

    def _spin(self) -> None:
        while not self._ending.is_set() and self._context.ok():
            try:
                self._executor.spin_once(timeout_sec=0.1)
            except Exception:  # an error with one message must not end the only reader
                log.exception("reading from rclpy failed")
                self._ending.wait(0.1)

    def _note(self, topic: Topic, event: Any, publishes: bool) -> None:
        from rclpy.qos import qos_policy_name_from_kind

        policy = str(qos_policy_name_from_kind(event.last_policy_kind)).lower().removesuffix("_qos_policy")
        self._refused[topic.name] = describe_incompatible(topic, policy, publishes)


def _kind(topic: Topic) -> Any:
    return getattr(importlib.import_module(f"{PACKAGES[topic.message]}.msg"), topic.message)


def _events() -> tuple[Any, Any]:
    """Return the classes of event callbacks for subscriptions and publishers.

    In ROS 2 Humble they are in another module than in later versions.
    """
    try:
        module = importlib.import_module("rclpy.event_handler")
    except ImportError:
        module = importlib.import_module("rclpy.qos_event")
    return module.SubscriptionEventCallbacks, module.PublisherEventCallbacks


def _quality(topic: Topic, publishes: bool) -> Any:
    from rclpy.duration import Duration
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    from runtime.transports.ros.middleware import COMMAND_LIFE_S

    requested = topic.quality
    reliable, latched = requested.reliability == "reliable", requested.durability == "transient_local"
    profile = QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=requested.depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
    if publishes:
        profile.lifespan = Duration(seconds=COMMAND_LIFE_S)
    return profile
