"""Zenoh: bytes in, bytes out. The only file that imports zenoh.

Callbacks run on threads of Zenoh's; they must only enqueue. What is put carries the CRC-32 of its bytes as
attachment, four bytes little-endian; what arrives with one that does not match is refused
(docs/decisions/0009-integrity-and-latched-values.md).
"""

import json
import re
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Literal, Self, TypeAlias

import zenoh
import zenoh.ext

from maniple.core.codec import encoding
from maniple.core.errors import TransportError
from maniple.core.topics import topic as topic_row

DEFAULT_PORT = 7447
"""Of the first router on a machine."""

LEASE_S = 2.0
"""A session that is silent for so long is over, unless said otherwise; wall time."""

MAX_BYTES = 8 << 20
"""No message is larger."""

Unfit: TypeAlias = Literal["corrupted", "unsealed", "huge"]
"""Why bytes that arrived are kept from everybody: not what was sent; without a CRC-32 on a topic whose sender
sends it; more than `MAX_BYTES`."""

OnUnfit: TypeAlias = Callable[[str, Unfit], None]
"""Told the topic name and why."""

OnRaw: TypeAlias = Callable[[str, bytes, bytes | None], None]
"""Told the name, the bytes and the attachment, if there is one."""

PATIENCE_S = 0.5
"""Who does not read for so long holds nobody up: its session ends, and it connects anew. Zenoh's default is
5 s."""

_TRY_S = 2.0
"""How long one attempt to connect takes at most, so that a signal is heeded in between."""
_CRC_BYTES = 4
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_NUMBER = re.compile(r"[1-9][0-9]{0,17}")

_PRIORITIES = {
    "commands": zenoh.Priority.INTERACTIVE_HIGH,
    "state": zenoh.Priority.DATA_HIGH,
    "sensors": zenoh.Priority.DATA,
    "background": zenoh.Priority.DATA_LOW,
}
_CONGESTION = {"drop": zenoh.CongestionControl.DROP, "block": zenoh.CongestionControl.BLOCK}
_RELIABILITY = {"reliable": zenoh.Reliability.RELIABLE, "best_effort": zenoh.Reliability.BEST_EFFORT}

_COMMON: Mapping[str, Any] = {
    "scouting/multicast/enabled": False,
    # The implicit default sends 3 KB and more through /dev/shm: slower, larger, and it leaves files.
    "transport/shared_memory/enabled": False,
    "transport/link/tx/keep_alive": 4,
    # A handshake over TCP that loses every fifth packet of a round trip of 0.2 s seldom takes less than 1 s.
    "transport/unicast/open_timeout": 5000,
    "transport/unicast/accept_timeout": 5000,
}

_ROOM: Mapping[str, Any] = {
    f"transport/link/tx/queue/size/{priority}": 16
    for priority in ("interactive_high", "data_high", "data", "data_low")
}
"""Batches of 64 KB that a router may hold for each receiver, by priority: the most there can be, where 2 are
usual. What a whole platoon says at once is not dropped while the router waits for a processor."""


class RawPublisher:
    """Puts bytes on one name, with any attachment."""

    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher

    def put(self, data: bytes, attachment: bytes | None = None) -> None:
        """Send bytes."""
        self._publisher.put(data, attachment=attachment)


class ZenohSession:
    """One session on one network. Topic names are relative to the prefix of the keys; with an empty prefix
    they are the keys."""

    def __init__(self, session: zenoh.Session, prefix: str) -> None:
        self._session = session
        self._prefix = f"{prefix}/" if prefix else ""
        self._skip = len(self._prefix)
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._ordered: dict[str, zenoh.Publisher] = {}
        self._announced: dict[tuple[str, int], Any] = {}
        self._kept: list[Any] = []
        self._raw: dict[int, Any] = {}

    @classmethod
    def client(
        cls,
        endpoint: str,
        prefix: str,
        timeout_s: float = 10.0,
        lease_s: float = LEASE_S,
        patience_s: float = PATIENCE_S,
    ) -> Self:
        """Connect to a router, for example "tcp/127.0.0.1:7447". Once connected, it connects again whenever
        the router is back, for as long as it is open.

        Raises:
            TransportError: nothing answers there within the time.
        """
        options = {
            "mode": "client",
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": round(min(timeout_s, _TRY_S) * 1000),
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
            **_timing(lease_s, patience_s),
        }
        failure = f"can't reach a router at {endpoint} within {timeout_s:g} s"
        return cls(_open(options, failure, time.monotonic() + timeout_s), prefix)

    @classmethod
    def router(
        cls, endpoint: str, prefix: str, lease_s: float = LEASE_S, patience_s: float = PATIENCE_S
    ) -> Self:
        """Be a router that listens, for example on "tcp/127.0.0.1:7447".

        Raises:
            TransportError: it can't listen there.
        """
        options = {
            "mode": "router",
            "listen/endpoints": [endpoint],
            "listen/exit_on_failure": True,
            # The default is to wait 500 ms for what multicast finds, which is off.
            "scouting/delay": 0,
            **_ROOM,
            **_timing(lease_s, patience_s),
        }
        return cls(
            _open(options, f"can't listen on {endpoint} (address in use, or not of this host)"), prefix
        )

    def put(self, name: str, data: bytes) -> None:
        """Send bytes on a topic of the table, with its priority, congestion control and reliability."""
        publisher = self._publishers.get(name)
        if publisher is None:
            row = topic_row(name)
            publisher = self._publishers[name] = self._session.declare_publisher(
                self._key(name),
                encoding=encoding(name),
                priority=_PRIORITIES[row.priority],
                congestion_control=_CONGESTION[row.congestion],
                reliability=_RELIABILITY[row.reliability],
            )
        publisher.put(data, attachment=crc_of(data))

    def put_in_order(self, name: str, data: bytes, encoding: str | None = None) -> None:
        """Send bytes on any name, sealed. What is put so is never dropped but waits for those who are slow,
        and it arrives in the order of the puts, whatever the names: all have one priority, the default."""
        publisher = self._ordered.get(name)
        if publisher is None:
            publisher = self._ordered[name] = self._session.declare_publisher(
                self._key(name),
                encoding=encoding,
                priority=zenoh.Priority.DATA,
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
            )
        publisher.put(data, attachment=crc_of(data))

    def put_raw(self, name: str, data: bytes, attachment: bytes | None = None) -> None:
        """Send bytes on any name, known to the table or not, with any attachment or none."""
        self._session.put(self._key(name), data, attachment=attachment)

    def raw_publisher(
        self, name: str, encoding: str | None = None, reliable: bool = True, history: int = 0
    ) -> RawPublisher:
        """To put bytes on one name again and again; those who are slow miss some. With a `history`, late
        comers that ask for it get so many of the last (Zenoh's advanced publisher)."""
        options: dict[str, Any] = {
            "encoding": encoding,
            "congestion_control": zenoh.CongestionControl.DROP,
            "reliability": _RELIABILITY["reliable" if reliable else "best_effort"],
        }
        key = self._key(name)
        if not history:
            return RawPublisher(self._session.declare_publisher(key, **options))
        return RawPublisher(
            zenoh.ext.declare_advanced_publisher(
                self._session,
                key,
                cache=zenoh.ext.CacheConfig(history),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
                publisher_detection=True,
                **options,
            )
        )

    def subscribe_raw(self, expression: str, on_sample: OnRaw, history: int = 0) -> Callable[[], None]:
        """Call `on_sample` for what others put, whatever it is, up to `MAX_BYTES`; with a `history` also for
        so many of the last that advanced publishers keep. What is returned ends that; it must not be called
        from `on_sample`."""

        def receive(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT and len(sample.payload) <= MAX_BYTES:
                attachment = None if sample.attachment is None else sample.attachment.to_bytes()
                on_sample(self._name(sample.key_expr), sample.payload.to_bytes(), attachment)

        key, remote = self._key(expression), zenoh.Locality.REMOTE
        subscriber: Any
        if history:
            subscriber = zenoh.ext.declare_advanced_subscriber(
                self._session,
                key,
                receive,
                allowed_origin=remote,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=history),
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                subscriber_detection=True,
            )
        else:
            subscriber = self._session.declare_subscriber(key, receive, allowed_origin=remote)
        return self._keep(subscriber)

    def serve_raw(
        self, expression: str, answer: Callable[[], Sequence[tuple[str, bytes, bytes | None]]]
    ) -> Callable[[], None]:
        """Answer queries for `expression` with (name, bytes, attachment), whatever those names are. What is
        returned ends that."""

        def reply(query: zenoh.Query) -> None:
            with query:
                for name, data, attachment in answer():
                    query.reply(self._key(name), data, attachment=attachment)

        return self._keep(self._session.declare_queryable(self._key(expression), reply))

    def declare_token(self, name: str) -> Callable[[], None]:
        """Declare a liveliness token of any name. It lasts for as long as this session, or until what is
        returned is called."""
        return self._keep(self._session.liveliness().declare_token(self._key(name)))

    def watch_tokens(self, expression: str, on_change: Callable[[str, bool], None]) -> Callable[[], None]:
        """Call `on_change(name, is there)` for every liveliness token there is, appears or goes. What is
        returned ends that."""

        def change(sample: zenoh.Sample) -> None:
            on_change(self._name(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        return self._keep(
            self._session.liveliness().declare_subscriber(self._key(expression), change, history=True)
        )

    @property
    def zid(self) -> str:
        """The identity of this session in the network, lower-case hexadecimal."""
        return str(self._session.info.zid())

    def subscribe(
        self,
        expression: str,
        on_sample: Callable[[str, bytes], None],
        on_unfit: OnUnfit | None = None,
        one_sender: Callable[[str], bool] = lambda _: False,
    ) -> None:
        """Call `on_sample(topic, bytes)` for what arrives from others, and `on_unfit` for what is not fit to
        be looked at; `expression` may hold `*` and `**`. Bytes without attachment are not checked; on topics
        that have `one_sender` they are unfit once that has sent some with one."""
        sealed: set[str] = set()

        def receive(sample: zenoh.Sample) -> None:
            name = self._name(sample.key_expr)
            data, unfit = _checked(sample)
            if unfit is None and (name in sealed or one_sender(name)):
                if _crc_in(sample) is not None:
                    sealed.add(name)
                elif name in sealed:
                    unfit = "unsealed"
            if unfit is None:
                on_sample(name, data)
            elif on_unfit is not None:
                on_unfit(name, unfit)

        self._kept.append(
            self._session.declare_subscriber(
                self._key(expression), receive, allowed_origin=zenoh.Locality.REMOTE
            )
        )

    def serve(self, expression: str, answer: Callable[[str], Mapping[str, bytes]]) -> None:
        """Answer queries for `expression`: `answer(asked name)` gives bytes by topic name."""

        def reply(query: zenoh.Query) -> None:
            with query:
                for name, data in answer(self._name(query.key_expr)).items():
                    query.reply(self._key(name), data, attachment=crc_of(data))

        self._kept.append(self._session.declare_queryable(self._key(expression), reply))

    def serve_later(self, name: str, asked: Callable[[bytes, Callable[[bytes], None]], None]) -> None:
        """Pass on queries for a name: `asked(what came with the query, reply)`; `reply` may be called once,
        later, from any thread."""
        key = self._key(name)

        def take(query: zenoh.Query) -> None:
            def reply(data: bytes) -> None:
                with query:
                    query.reply(key, data, attachment=crc_of(data))

            asked(b"" if query.payload is None else query.payload.to_bytes(), reply)

        self._kept.append(self._session.declare_queryable(key, take))

    def ask(self, name: str, timeout_s: float = 2.0, data: bytes | None = None) -> dict[str, bytes]:
        """What is answered to a name, of the router what it keeps: bytes by topic name; empty where nobody
        answers. `data` goes with the query."""
        answers: dict[str, bytes] = {}
        for reply in self._session.get(self._key(name), timeout=timeout_s, payload=data):
            if reply.ok is not None:
                data, unfit = _checked(reply.ok)
                if unfit is None:
                    answers[self._name(reply.ok.key_expr)] = data
        return answers

    def settle(self) -> None:
        """Wait until the router knows every subscription made here: what is put from now on arrives."""
        self.ask("settle")

    @property
    def connected(self) -> bool:
        """Whether a client has its router; what it puts meanwhile is lost."""
        return bool(self._session.info.routers_zid())

    def announce(self, node: str, incarnation: int) -> None:
        """Show that a life of a node is there, until it is withdrawn, or for as long as this session is."""
        key = self._key(f"alive/{node}/{incarnation}")
        self._announced[node, incarnation] = self._session.liveliness().declare_token(key)

    def withdraw(self, node: str, incarnation: int) -> None:
        """Show no more that a life is there that was announced here."""
        self._announced.pop((node, incarnation)).undeclare()

    def lives(self, node: str, timeout_s: float = 2.0) -> tuple[int, ...]:
        """The lives of a node that are there now; to be asked before `watch`."""
        return self._tokens(node, timeout_s).get(node, ())

    def everyone(self, timeout_s: float = 2.0) -> dict[str, tuple[int, ...]]:
        """The lives that are there now, of every node. To be asked before `watch`, which answers in part
        while it learns."""
        return self._tokens("*", timeout_s)

    def _tokens(self, node: str, timeout_s: float) -> dict[str, tuple[int, ...]]:
        lives: dict[str, set[int]] = {}
        for reply in self._session.liveliness().get(self._key(f"alive/{node}/*"), timeout=timeout_s):
            if reply.ok is not None:
                for name, life in _life_of(str(reply.ok.key_expr)):
                    lives.setdefault(name, set()).add(life)
        return {name: tuple(sorted(found)) for name, found in sorted(lives.items())}

    def watch(self, on_change: Callable[[str, int, bool], None]) -> None:
        """Call `on_change(node, incarnation, alive)` for every life there is, begins or ends."""

        def change(sample: zenoh.Sample) -> None:
            for node, life in _life_of(str(sample.key_expr)):
                on_change(node, life, sample.kind == zenoh.SampleKind.PUT)

        self._kept.append(
            self._session.liveliness().declare_subscriber(self._key("alive/*/*"), change, history=True)
        )

    def close(self) -> None:
        """End the session; what was put before is still sent."""
        self._session.close()
        self._kept.clear()
        self._raw.clear()
        self._announced.clear()
        self._publishers.clear()
        self._ordered.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _key(self, name: str) -> str:
        return self._prefix + name

    def _name(self, key: zenoh.KeyExpr) -> str:
        return str(key)[self._skip :]

    def _keep(self, declared: Any) -> Callable[[], None]:
        """Hold on to something that was declared; what is returned lets go of it."""
        self._raw[id(declared)] = declared

        def end() -> None:
            if self._raw.pop(id(declared), None) is not None:
                declared.undeclare()

        return end


def _timing(lease_s: float, patience_s: float) -> dict[str, int]:
    """How long others may be silent, and how long they may not read."""
    return {
        "transport/link/tx/lease": round(lease_s * 1000),
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(patience_s * 1e6),
    }


def crc_of(data: bytes) -> bytes:
    """The attachment of bytes: their CRC-32, little-endian."""
    return zlib.crc32(data).to_bytes(_CRC_BYTES, "little")


def _checked(sample: zenoh.Sample) -> tuple[bytes, Unfit | None]:
    """The bytes of a sample, or why they are unfit. An attachment of another length is somebody else's."""
    if len(sample.payload) > MAX_BYTES:
        return b"", "huge"
    data = sample.payload.to_bytes()
    crc = _crc_in(sample)
    return (b"", "corrupted") if crc is not None and crc != crc_of(data) else (data, None)


def _crc_in(sample: zenoh.Sample) -> bytes | None:
    """The attachment, if it is a CRC-32."""
    crc = None if sample.attachment is None else sample.attachment.to_bytes()
    return crc if crc is not None and len(crc) == _CRC_BYTES else None


def _life_of(key: str) -> Iterator[tuple[str, int]]:
    """The node and the incarnation of a liveliness token's key; nothing of one that somebody made up."""
    _, node, life = key.rsplit("/", 2)
    if _NAME.fullmatch(node) and _NUMBER.fullmatch(life):
        yield node, int(life)


def _open(options: Mapping[str, Any], failure: str, until: float = 0.0) -> zenoh.Session:
    """Open a session; until a monotonic time, s, try again where that fails."""
    zenoh.init_log_from_env_or("off")
    while True:
        config = zenoh.Config()
        for path, value in {**_COMMON, **options}.items():
            try:
                config.insert_json5(path, json.dumps(value))
            except zenoh.ZError:
                raise TransportError(f"{failure}: an endpoint looks like tcp/127.0.0.1:7447") from None
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            if time.monotonic() >= until:
                raise TransportError(failure) from None
