"""A ROS 2 node on Zenoh, without ROS: it publishes, subscribes, shows itself, and sees who else is there.

Nothing here needs ROS on this side, nor a plugin in the router. How things are named on the wire is in
`maniple.transport.ros2_keys`.
"""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from types import TracebackType
from typing import Any, NamedTuple, Self, TypeAlias

from maniple.core.errors import MessageError
from maniple.transport.ros2_cdr import decode, encode, gid_of, require, type_hash
from maniple.transport.ros2_keys import (
    NO_HASH,
    Attachment,
    Entity,
    EntityKind,
    Layout,
    Qos,
    absolute,
    all_tokens,
    attachment_of,
    bridge_token,
    cache_key,
    data_key,
    endpoint_token,
    entity_of,
    hash_in,
    node_token,
)
from maniple.transport.zenoh import RawPublisher, ZenohSession

CDR = "application/cdr"
"""The Zenoh encoding of what is published."""

MOST_ENTITIES = 10_000
"""Of others, no more are remembered: tokens may be forged."""

OnMessage: TypeAlias = Callable[[Any, Attachment], None]
"""Told the message and who published it when. The layout "ros2dds" does not say that: all zero, and empty."""

_UNKNOWN = Attachment(0, 0, b"")


class Network(NamedTuple):
    """Which of the ROS 2 networks on a router."""

    layout: Layout = "rmw_zenoh"
    domain_id: int = 0
    """ROS_DOMAIN_ID; the layout "ros2dds" has none."""
    enclave: str = "/"
    """Security enclave that tokens tell; "/" for none."""


class RosPublisher:
    """Publishes messages of one type on one topic; from any thread."""

    def __init__(self, session: "RosSession", entity: Entity, gid: bytes) -> None:
        self._session, self._entity, self._gid = session, entity, gid
        self._lock = threading.Lock()
        self._outlets: dict[str, RawPublisher] = {}
        self._sequence = 0
        self._last: deque[tuple[str, bytes, bytes | None]] = deque(maxlen=_qos(entity).depth or None)
        if _qos(entity).latched and session.network.layout == "ros2dds":
            key = self._key(entity.hash)
            session.zenoh.serve_raw(cache_key(session.zenoh.zid, key), lambda: tuple(self._last))

    @property
    def topic(self) -> str:
        """Its full name."""
        return self._entity.topic

    @property
    def published(self) -> int:
        """How many messages so far."""
        return self._sequence

    @property
    def subscriptions(self) -> tuple[Entity, ...]:
        """Who takes them, as far as is known."""
        return self._session.entities("MS", self.topic, self._entity.type)

    def publish(self, message: Any) -> None:
        """Send a message. What is sent while the router is gone is lost, but for a latched topic's last.

        Raises:
            MessageError: it is of another type than the topic.
        """
        if message.__msgtype__ != self._entity.type:
            raise MessageError(f"{self.topic} takes {self._entity.type}, not {message.__msgtype__}")
        data = encode(message)
        with self._lock:
            self._sequence += 1
            if self._session.network.layout == "ros2dds":
                self._put(self._entity.hash, data, None)
                return
            attachment = Attachment(self._sequence, time.time_ns(), self._gid).pack()
            self._put(self._entity.hash, data, attachment)
            if self._session.is_unhashed(self.topic):
                self._put(NO_HASH, data, attachment)

    def _put(self, type_hash: str, data: bytes, attachment: bytes | None) -> None:
        key, qos = self._key(type_hash), _qos(self._entity)
        if key not in self._outlets:
            cached = qos.latched and self._session.network.layout == "rmw_zenoh"
            self._outlets[key] = self._session.zenoh.raw_publisher(
                key, CDR, qos.reliable, history=(qos.depth or 1) if cached else 0
            )
        if qos.latched:
            self._last.append((key, data, attachment))
        self._outlets[key].put(data, attachment)

    def _key(self, type_hash: str) -> str:
        layout, domain_id, _ = self._session.network
        return data_key(layout, domain_id, self.topic, self._entity.type, type_hash)


class RosSubscription:
    """Hears messages of one type on one topic, of any publisher."""

    def __init__(self, network: Network, entity: Entity, on_message: OnMessage) -> None:
        self._network, self._entity, self._on_message = network, entity, on_message
        self.received = 0
        """Messages passed on."""
        self.bad = 0
        """What was no such message: it can't be decoded, or has not the attachment there has to be."""
        self.other = 0
        """Of a type of the same name with another definition."""

    @property
    def topic(self) -> str:
        """Its full name."""
        return self._entity.topic

    def take(self, key: str, data: bytes, attachment: bytes | None) -> None:
        """What arrived; called by Zenoh's threads."""
        origin: Attachment | None = _UNKNOWN
        if self._network.layout == "rmw_zenoh":
            if hash_in(key) not in (self._entity.hash, NO_HASH):
                self.other += 1
                return
            origin = attachment_of(attachment)
        try:
            if origin is None:
                raise MessageError(f"{key}: without the attachment of rmw_zenoh")
            message = decode(data, self._entity.type)
        except MessageError:
            self.bad += 1
            return
        self.received += 1
        self._on_message(message, origin)


class RosSession:
    """One ROS 2 node on one Zenoh session.

    Callbacks run on Zenoh's threads: they must only enqueue.
    """

    def __init__(
        self, session: ZenohSession, node: str, namespace: str = "/", network: Network | None = None
    ) -> None:
        """`session` has no prefix. It is closed with this.

        Raises:
            ArgumentError: the node or the namespace has no name that ROS 2 knows.
            MissingExtraError: rosbags is not installed.
        """
        require()
        absolute(node)
        self.zenoh, self.network = session, network or Network()
        self._node, self._namespace = node, absolute(namespace)
        self._zid = session.zid
        self._lock = threading.Lock()
        self._entities: dict[str, Entity] = {}
        self._unhashed: Counter[str] = Counter()
        self._endpoints = 0
        layout, domain_id, enclave = self.network
        session.watch_tokens(all_tokens(layout, domain_id), self._change)
        if layout == "rmw_zenoh":
            session.declare_token(node_token(domain_id, self._zid, node, self._namespace, enclave))
        else:
            session.declare_token(bridge_token(self._zid))

    @classmethod
    def open(
        cls,
        endpoint: str,
        node: str,
        namespace: str = "/",
        network: Network | None = None,
        timeout_s: float = 10.0,
    ) -> Self:
        """Connect to the router of the ROS 2 side, for example "tcp/127.0.0.1:7447". Once connected, it
        connects again whenever the router is back.

        Raises:
            TransportError: nothing answers there within the time.
            ArgumentError: the node or the namespace has no name that ROS 2 knows.
            MissingExtraError: rosbags is not installed.
        """
        require()
        session = ZenohSession.client(endpoint, "", timeout_s)
        try:
            return cls(session, node, namespace, network)
        except BaseException:
            session.close()
            raise

    @property
    def connected(self) -> bool:
        """Whether the router is there."""
        return self.zenoh.connected

    def advertise(self, topic: str, type_name: str, qos: Qos | None = None) -> RosPublisher:
        """Publish on a topic, which is under the node's namespace unless it begins with a slash.

        Raises:
            ArgumentError: that is no name of a topic.
            MessageError: ROS 2 has no such type.
        """
        entity, token = self._declare("MP", topic, type_name, qos or Qos())
        return RosPublisher(self, entity, gid_of(token))

    def subscribe(
        self,
        topic: str,
        type_name: str,
        on_message: OnMessage,
        qos: Qos | None = None,
        announced: bool = True,
    ) -> RosSubscription:
        """Hear a topic, likewise. With a latched `qos` also what its publishers keep (in the layout
        "ros2dds" only what comes from now on). Who only looks on is not `announced`.

        Raises:
            ArgumentError: that is no name of a topic.
            MessageError: ROS 2 has no such type.
        """
        entity, _ = self._declare("MS", topic, type_name, qos or Qos(), announced)
        subscription = RosSubscription(self.network, entity, on_message)
        layout, domain_id, _ = self.network
        key = data_key(layout, domain_id, entity.topic, type_name, "*")
        cached = _qos(entity).latched and layout == "rmw_zenoh"
        self.zenoh.subscribe_raw(key, subscription.take, history=(_qos(entity).depth or 1) if cached else 0)
        return subscription

    def entities(self, kind: EntityKind, topic: str = "", type_name: str = "") -> tuple[Entity, ...]:
        """What others have that is there now: of a kind, on one topic (full name) or any, of one type or
        any."""
        with self._lock:
            found = tuple(self._entities.values())
        return tuple(
            entity
            for entity in found
            if entity.kind == kind and topic in ("", entity.topic) and type_name in ("", entity.type)
        )

    def is_unhashed(self, topic: str) -> bool:
        """Whether somebody listens there who knows no type hashes (ROS 2 Humble)."""
        return self._unhashed[topic] > 0

    def close(self) -> None:
        """Leave the network."""
        self.zenoh.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _declare(
        self, kind: EntityKind, topic: str, type_name: str, qos: Qos, announced: bool = True
    ) -> tuple[Entity, str]:
        name, digest = absolute(topic, self._namespace), type_hash(type_name)
        entity = Entity(kind, self._node, self._namespace, name, type_name, digest, qos, self._zid)
        self._endpoints += 1
        layout, domain_id, enclave = self.network
        token = endpoint_token(layout, domain_id, self._endpoints, entity, enclave)
        if announced:
            self.zenoh.declare_token(token)
        return entity, token

    def _change(self, token: str, there: bool) -> None:
        entity = entity_of(self.network.layout, token)
        if entity is None or entity.zid == self._zid:
            return
        with self._lock:
            known = token in self._entities
            if there == known or (there and len(self._entities) >= MOST_ENTITIES):
                return
            if there:
                self._entities[token] = entity
            else:
                del self._entities[token]
            if entity.kind == "MS" and entity.hash == NO_HASH:
                self._unhashed[entity.topic] += 1 if there else -1


def _qos(entity: Entity) -> Qos:
    return entity.qos or Qos()
