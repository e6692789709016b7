"""What the network does to a message, as a pure decision.

A decision depends only on (plan, seed, link, incarnation, seq) and, for windows, on the sender's stamp:
the same messages are lost in every run and in both hosts, whatever the timing.
"""

import hashlib
import struct
from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

from maniple.core.scenario.types import Fault, Scenario
from maniple.core.time import Duration, from_seconds


class Decision(NamedTuple):
    """What becomes of one message on one link."""

    dropped: bool
    delay: Duration
    """In addition to the least latency of the network, in ns."""


def matches(rule: Fault, source: str, destination: str, topic: str) -> bool:
    """Whether a rule applies to a directed link."""
    return (
        fnmatchcase(source, rule.source)
        and fnmatchcase(destination, rule.destination)
        and fnmatchcase(topic, rule.topic)
    )


def beside(node: str, scenario: Scenario) -> frozenset[str]:
    """The nodes on the same computer, itself among them: no network fails between these."""
    host = scenario.controller.host
    here = {"controller", host} if host is not None and node in ("controller", host) else set()
    return frozenset({node, *here})


def dies_with(node: str, scenario: Scenario) -> tuple[str, ...]:
    """The nodes that end with one: a controller ends with the robot it runs on, not the robot with it."""
    return (node, "controller") if node == scenario.controller.host else (node,)


class Link:
    """The faults of one directed link: source, destination and topic.

    Every rule of the plan that matches applies: delays add up, losses are independent of each other.
    """

    def __init__(self, plan: Sequence[Fault], seed: int, source: str, destination: str, topic: str) -> None:
        self._rules = tuple(
            (from_seconds(rule.latency_s), from_seconds(rule.jitter_s), rule.loss, index)
            for index, rule in enumerate(plan)
            if matches(rule, source, destination, topic)
        )
        identity = "\0".join((str(seed), source, destination, topic))
        self._key = hashlib.blake2b(identity.encode(), digest_size=32).digest()

    def __bool__(self) -> bool:
        """Whether any rule applies to this link."""
        return bool(self._rules)

    def decide(self, incarnation: int, seq: int) -> Decision:
        """What becomes of the message (incarnation, seq) of this link."""
        dropped = False
        delay = 0
        for latency, jitter, loss, index in self._rules:
            lose, wait = self._uniform(incarnation, seq, index)
            dropped = dropped or lose < loss
            delay += latency + round(jitter * (2.0 * wait - 1.0))
        return Decision(dropped, max(delay, 0))

    def _uniform(self, incarnation: int, seq: int, rule: int) -> tuple[float, float]:
        """Two independent numbers, uniform in [0, 1): a keyed hash of the message and the rule."""
        counter = struct.pack("<qqq", incarnation, seq, rule)
        first, second = struct.unpack("<QQ", hashlib.blake2b(counter, key=self._key, digest_size=16).digest())
        return (first >> 11) * 2.0**-53, (second >> 11) * 2.0**-53
