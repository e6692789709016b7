"""What the network does to a message, as a pure decision.

It depends only on (plan, seed, link, incarnation, seq) and, for windows and partitions, on when the message
was sent: the same messages are lost in every run and in both hosts, whatever the timing. Only the queue of a
rate limit has a state.
"""

import hashlib
import struct
from collections.abc import MutableMapping
from typing import NamedTuple, TypeAlias

from maniple.core.bursts import BurstChain
from maniple.core.faults import Span, holds, matches, separates, span_of, windows_of
from maniple.core.messages import Cause, FaultPlan
from maniple.core.scenario.types import Fault
from maniple.core.time import SECOND, Duration, Time, from_seconds


class Decision(NamedTuple):
    """What becomes of one message on one link."""

    cause: Cause
    """Why it is lost; empty where it is not."""
    delay: Duration
    """In addition to the least latency of the network, in ns."""
    copy_delay: Duration | None = None
    """Of the second copy, likewise, where there is one."""
    corrupted: bool = False
    """Whether bits of it, and of its copy, are flipped."""

    @property
    def dropped(self) -> bool:
        """Whether it is lost."""
        return self.cause != ""


class RateQueue:
    """What waits before a link of limited rate, from one node to another."""

    def __init__(self, rate_kbps: float, queue_s: float) -> None:
        self._ns_per_byte = 8e6 / rate_kbps
        self._longest = from_seconds(queue_s)
        self._free_at: Time = 0
        self._last: Time = 0

    def enter(self, stamp_ns: Time, size: int) -> Duration | None:
        """How long a message of `size` bytes, sent at this time, waits and takes; None where the queue is
        full. A stamp far behind the last one is of a clock that was off: the queue starts anew."""
        jumped = stamp_ns < self._last - self._longest - SECOND
        wait = 0 if jumped else max(self._free_at - stamp_ns, 0)
        self._last = stamp_ns
        if wait > self._longest:
            return None
        took = wait + round(size * self._ns_per_byte)
        self._free_at = stamp_ns + took
        return took


Queues: TypeAlias = MutableMapping[tuple[int, str], RateQueue]
"""The queues before one destination, by rule and source: all topics of a source share one."""


class _Rule(NamedTuple):
    """A rule that matches a link, in ns."""

    number: int
    latency: Duration
    jitter: Duration
    loss: float
    windows: tuple[Span, ...]
    fault: Fault
    chain: BurstChain | None
    queue: RateQueue | None


class _Beyond(NamedTuple):
    """What a rule does to a message besides loss and delay."""

    burst: bool
    copied: bool
    corrupted: bool
    held: Duration
    copy_delay: Duration


class Link:
    """The faults of one directed link: source, destination and topic.

    Every rule of the plan that matches applies: delays add up, losses are independent of each other.
    """

    def __init__(
        self,
        plan: FaultPlan,
        seed: int,
        source: str,
        destination: str,
        topic: str,
        queues: Queues | None = None,
    ) -> None:
        queues = {} if queues is None else queues
        self._rules = tuple(
            self._rule(plan, index, rule, source, queues)
            for index, rule in enumerate(plan.faults)
            if matches(rule, source, destination, topic)
        )
        self._cuts = tuple(
            span_of(plan, partition)
            for partition in plan.partitions
            if separates(partition, source, destination)
        )
        self._plain = not any(_has_more(rule.fault) for rule in self._rules)
        identity = "\0".join((str(seed), source, destination, topic))
        self._key = hashlib.blake2b(identity.encode(), digest_size=32).digest()

    def __bool__(self) -> bool:
        """Whether anything applies to this link."""
        return bool(self._rules or self._cuts)

    def decide(self, incarnation: int, seq: int, stamp_ns: Time, size: int) -> Decision:
        """What becomes of the message (incarnation, seq) of this link: of `size` bytes, sent at `stamp_ns` of
        true scenario time."""
        if self._cuts and holds(self._cuts, stamp_ns):
            return Decision("cut", 0)
        lost = burst = full = copied = corrupted = False
        delay = copy_delay = 0
        for rule in self._rules:
            if rule.windows and not holds(rule.windows, stamp_ns):
                continue
            lose, wait = self._uniform(incarnation, seq, rule.number)
            lost = lost or lose < rule.loss
            delay += rule.latency + round(rule.jitter * (2.0 * wait - 1.0))
            if rule.queue is not None and not full:
                waits = rule.queue.enter(stamp_ns, size)
                full = waits is None
                delay += waits or 0
                copy_delay += waits or 0
            if self._plain:
                continue
            more = self._beyond(rule, incarnation, seq)
            burst = burst or more.burst
            copied = copied or more.copied
            corrupted = corrupted or more.corrupted
            delay += more.held
            copy_delay += more.copy_delay
        cause: Cause = "loss" if lost else "burst" if burst else "rate" if full else ""
        return Decision(cause, max(delay, 0), max(copy_delay, 0) if copied else None, corrupted)

    def flipped(self, incarnation: int, seq: int, data: bytes) -> bytes:
        """The bytes of a corrupted message: 1 to 8 bits of it are flipped."""
        counter = struct.pack("<qqq", incarnation, seq, -1)
        digest = hashlib.blake2b(counter, key=self._key, digest_size=36).digest()
        number, *places = struct.unpack("<9I", digest)
        result = bytearray(data or b"\0")
        for place in {place % (8 * len(result)) for place in places[: 1 + number % 8]}:
            result[place // 8] ^= 1 << place % 8
        return bytes(result)

    def _rule(self, plan: FaultPlan, number: int, fault: Fault, source: str, queues: Queues) -> _Rule:
        queue = chain = None
        if fault.rate_kbps is not None and (queue := queues.get((number, source))) is None:
            queue = queues[number, source] = RateQueue(fault.rate_kbps, fault.queue_s)
        if fault.burst is not None:
            chain = BurstChain(
                fault.burst, lambda life, block, count: self._uniform(life, block, number, count)
            )
        return _Rule(
            number,
            from_seconds(fault.latency_s),
            from_seconds(fault.jitter_s),
            fault.loss,
            windows_of(plan, fault),
            fault,
            chain,
            queue,
        )

    def _beyond(self, rule: _Rule, incarnation: int, seq: int) -> _Beyond:
        """What a rule does besides loss and delay."""
        fault = rule.fault
        hit, copies, wait, held, copy_held, flips = self._more(incarnation, seq, rule.number)
        back = from_seconds(fault.reorder_s)
        copy_delay = rule.latency + round(rule.jitter * (2.0 * wait - 1.0))
        return _Beyond(
            burst=self._in_burst(rule, incarnation, seq, hit),
            copied=copies < fault.duplicate,
            corrupted=flips < fault.corrupt,
            held=back if held < fault.reorder else 0,
            copy_delay=copy_delay + (back if copy_held < fault.reorder else 0),
        )

    def _in_burst(self, rule: _Rule, incarnation: int, seq: int, hit: float) -> bool:
        burst = rule.fault.burst
        if burst is None or rule.chain is None:
            return False
        bad = rule.chain.is_bad(incarnation, seq)
        return hit < (burst.loss_bad if bad else burst.loss_good)

    def _uniform(self, incarnation: int, seq: int, *rule: int) -> tuple[float, float]:
        """Two independent numbers, uniform in [0, 1): a keyed hash of the message and the rule."""
        counter = struct.pack(f"<{2 + len(rule)}q", incarnation, seq, *rule)
        first, second = struct.unpack("<QQ", hashlib.blake2b(counter, key=self._key, digest_size=16).digest())
        return (first >> 11) * 2.0**-53, (second >> 11) * 2.0**-53

    def _more(self, incarnation: int, seq: int, rule: int) -> tuple[float, ...]:
        """Six more of them, independent of these."""
        counter = struct.pack("<qqq", incarnation, seq, rule)
        words = struct.unpack("<6Q", hashlib.blake2b(counter, key=self._key, digest_size=48).digest())
        return tuple((word >> 11) * 2.0**-53 for word in words)


def _has_more(rule: Fault) -> bool:
    return rule.burst is not None or rule.duplicate > 0.0 or rule.reorder > 0.0 or rule.corrupt > 0.0
