"""Zenoh: bytes in, bytes out. The only file that imports zenoh.

Callbacks run on threads of Zenoh's; they must only enqueue.
"""

import json
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self

import zenoh

from maniple.core.codec import encoding
from maniple.core.errors import TransportError
from maniple.core.topics import topic as topic_row

DEFAULT_PORT = 7447
"""Of the first router on a machine."""

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
    "transport/link/tx/lease": 2000,
    "transport/link/tx/keep_alive": 4,
    "transport/unicast/open_timeout": 1000,
    "transport/unicast/accept_timeout": 1000,
}


class ZenohSession:
    """One session on one network. Topic names are relative to the prefix of the keys."""

    def __init__(self, session: zenoh.Session, prefix: str) -> None:
        self._session = session
        self._prefix = prefix
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._kept: list[Any] = []

    @classmethod
    def client(cls, endpoint: str, prefix: str, timeout_s: float = 10.0) -> Self:
        """Connect to a router, for example "tcp/127.0.0.1:7447".

        Raises:
            TransportError: nothing answers there within the time.
        """
        options = {
            "mode": "client",
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": round(timeout_s * 1000),
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
        }
        return cls(_open(options, f"can't reach a router at {endpoint} within {timeout_s:g} s"), prefix)

    @classmethod
    def router(cls, endpoint: str, prefix: str) -> Self:
        """Be a router that listens, for example on "tcp/127.0.0.1:7447".

        Raises:
            TransportError: it can't listen there.
        """
        options = {"mode": "router", "listen/endpoints": [endpoint], "listen/exit_on_failure": True}
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
        publisher.put(data)

    def put_raw(self, name: str, data: bytes, attachment: bytes | None = None) -> None:
        """Send bytes on any name, known to the table or not."""
        self._session.put(self._key(name), data, attachment=attachment)

    def subscribe(self, expression: str, on_sample: Callable[[str, bytes], None]) -> None:
        """Call `on_sample(topic, bytes)` for what arrives from others; `expression` may hold `*` and `**`."""
        skip = len(self._prefix) + 1

        def receive(sample: zenoh.Sample) -> None:
            on_sample(str(sample.key_expr)[skip:], sample.payload.to_bytes())

        self._kept.append(
            self._session.declare_subscriber(
                self._key(expression), receive, allowed_origin=zenoh.Locality.REMOTE
            )
        )

    def serve(self, expression: str, answer: Callable[[str], Mapping[str, bytes]]) -> None:
        """Answer queries for `expression`: `answer(asked name)` gives bytes by topic name."""
        skip = len(self._prefix) + 1

        def reply(query: zenoh.Query) -> None:
            with query:
                for name, data in answer(str(query.key_expr)[skip:]).items():
                    query.reply(self._key(name), data)

        self._kept.append(self._session.declare_queryable(self._key(expression), reply))

    def ask(self, name: str, timeout_s: float = 2.0) -> dict[str, bytes]:
        """What the router keeps under a name: bytes by topic name; empty where nobody answers."""
        skip = len(self._prefix) + 1
        answers: dict[str, bytes] = {}
        for reply in self._session.get(self._key(name), timeout=timeout_s):
            if reply.ok is not None:
                answers[str(reply.ok.key_expr)[skip:]] = reply.ok.payload.to_bytes()
        return answers

    def settle(self) -> None:
        """Wait until the router knows every subscription made here: what is put from now on arrives."""
        self.ask("settle")

    def announce(self, node: str, incarnation: int) -> None:
        """Show that a life of a node is there, for as long as this session is."""
        key = self._key(f"alive/{node}/{incarnation}")
        self._kept.append(self._session.liveliness().declare_token(key))

    def lives(self, node: str, timeout_s: float = 2.0) -> tuple[int, ...]:
        """The lives of a node that are there now."""
        return self._tokens(node, timeout_s).get(node, ())

    def everyone(self, timeout_s: float = 2.0) -> dict[str, tuple[int, ...]]:
        """The lives that are there now, of every node."""
        return self._tokens("*", timeout_s)

    def _tokens(self, node: str, timeout_s: float) -> dict[str, tuple[int, ...]]:
        lives: dict[str, set[int]] = {}
        for reply in self._session.liveliness().get(self._key(f"alive/{node}/*"), timeout=timeout_s):
            if reply.ok is not None:
                _, name, life = str(reply.ok.key_expr).rsplit("/", 2)
                if life.isdecimal():
                    lives.setdefault(name, set()).add(int(life))
        return {name: tuple(sorted(found)) for name, found in sorted(lives.items())}

    def watch(self, on_change: Callable[[str, int, bool], None]) -> None:
        """Call `on_change(node, incarnation, alive)` for every life there is, begins or ends."""
        skip = len(self._prefix) + 1

        def change(sample: zenoh.Sample) -> None:
            _, node, incarnation = str(sample.key_expr)[skip:].split("/")
            if incarnation.isdecimal():
                on_change(node, int(incarnation), sample.kind == zenoh.SampleKind.PUT)

        self._kept.append(
            self._session.liveliness().declare_subscriber(self._key("alive/*/*"), change, history=True)
        )

    def close(self) -> None:
        """End the session; what was put before is still sent."""
        self._session.close()
        self._kept.clear()
        self._publishers.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _key(self, name: str) -> str:
        return f"{self._prefix}/{name}"


def _open(options: Mapping[str, Any], failure: str) -> zenoh.Session:
    zenoh.init_log_from_env_or("off")
    config = zenoh.Config()
    for path, value in {**_COMMON, **options}.items():
        try:
            config.insert_json5(path, json.dumps(value))
        except zenoh.ZError:
            raise TransportError(f"{failure}: an endpoint looks like tcp/127.0.0.1:7447") from None
    try:
        return zenoh.open(config)
    except zenoh.ZError:
        raise TransportError(failure) from None
