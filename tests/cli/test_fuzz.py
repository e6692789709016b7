"""Garbage on every topic of a running platoon: nothing falls over, all of it is counted, nothing changes."""

import json
import re
import subprocess
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import pytest
import zenoh

from maniple.cli.nodes import factories
from maniple.core import codec, topics
from maniple.core.messages import Journal, Refused
from maniple.core.scenario.types import Scenario
from maniple.core.topics import TOPICS
from maniple.host.recorder import keys_of
from maniple.recording.reader import Recording, read
from tests.cli.scenes import start, write

PAYLOADS = 100_000
A_SECOND = 2_500
HUGE = 40
"""Of them larger than any message."""

SCENE = """
name = "fuzzed"
task = { kind = "line", start = [0, 0], end = [9, 0], speed_mps = 0.15, settle_s = 10.0 }
formation.points = [[1, 0], [0, 0.8], [0, -0.8]]
robots = [{ id = "r1" }, { id = "r2" }, { id = "r3" }]
guard.clearance = false
"""


@pytest.mark.slow
def test_a_hundred_thousand_payloads_on_every_topic(tmp_path: Path) -> None:
    log = tmp_path / "fuzzed.mcap"
    running = start("run", write(tmp_path, SCENE), "--speed", 1, "--log", log, "--json")
    try:
        endpoint = endpoint_of(running)
        with open_session(endpoint) as session:
            sent = fuzz(session, Random(4))
        out, err = running.communicate(timeout=300)
    finally:
        running.kill()
    assert running.returncode == 0, err
    result = json.loads(out)
    assert result["completed"]
    assert result["lost_robots"] == []
    for which, most in (("final_error", 0.02), ("peak_error", 0.15)):  # a busy machine may be late at times
        errors = result[which]
        assert max(errors["position_m"], errors["distance_m"]) < most, "the formation is unaffected"
    assert_counted(sent, read(log))


def endpoint_of(running: "subprocess.Popen[str]") -> str:
    """Where the router of a run listens, once its platoon is under way."""
    assert running.stderr is not None
    for line in running.stderr:
        if found := re.search(r"tcp/127\.0\.0\.1:\d+", line):
            return found[0]
    raise AssertionError("the run does not say where it can be reached")


def open_session(endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def fuzz(session: zenoh.Session, random: Random) -> Counter[str]:
    """Put garbage on every topic there is and some there are not; what was sent, by topic."""
    heard: dict[str, bytes] = {}
    listener = session.declare_subscriber(
        "maniple/**",
        lambda sample: heard.__setitem__(str(sample.key_expr)[8:], sample.payload.to_bytes()),
        allowed_origin=zenoh.Locality.REMOTE,
    )
    names = [
        row.pattern.replace("{id}", robot) for row in TOPICS for robot in ("r1", "r2", "r3", "controller")
    ]
    names = sorted({*names, "nonsense", "robot/r9/odometry", "robot/r1", "clock", "seen", "incarnation/r1"})
    until = time.monotonic() + 20.0
    while len(heard) < 12 and time.monotonic() < until:
        time.sleep(0.1)
    sent: Counter[str] = Counter()
    begin = time.monotonic()
    for k in range(PAYLOADS):
        name = names[k % len(names)]
        payload = (
            bytes(9 << 20) if k % (PAYLOADS // HUGE) == 7 else garbage(random, heard.get(name, b""), name)
        )
        session.put(f"maniple/{name}", payload, congestion_control=zenoh.CongestionControl.BLOCK)
        sent[name] += 1
        time.sleep(max(begin + (k + 1) / A_SECOND - time.monotonic(), 0.0) if k % 50 == 0 else 0.0)
    listener.undeclare()
    return sent


def garbage(random: Random, real: bytes, name: str) -> bytes:
    """Random bytes; a real message cut short, or with flipped bits; or the right form with wild values. Never
    a valid order of an operator: that would be obeyed."""
    kind = random.randrange(5)
    if kind == 0 or not real:
        return random.randbytes(random.randrange(2000))
    if kind == 1:
        return real[: random.randrange(len(real))]
    if name in (topics.FORMATION_GOAL, topics.PLAN, topics.STOP):
        return b"\xc1" + real
    if kind == 2:
        flipped = bytearray(real)
        for _ in range(random.randrange(1, 9)):
            flipped[random.randrange(len(real))] ^= 1 << random.randrange(8)
        return bytes(flipped)
    fields: dict[str, Any] = msgspec.msgpack.decode(real)
    fields["seq"] = random.choice([0, fields["seq"] + 1, fields["seq"] + random.randrange(1000), 2**61, -1])
    fields["incarnation"] = random.choice([fields["incarnation"], fields["incarnation"] + 1, 2**61])
    fields["source"] = random.choice([fields["source"], "r1", "controller", "nobody", "x" * 300])
    for field, value in fields.items():
        if isinstance(value, float) and kind == 4:
            fields[field] = random.choice([float("nan"), float("inf"), 1e300, -1e30])
    return msgspec.msgpack.encode(fields)


def assert_counted(sent: Mapping[str, int], recording: Recording) -> None:
    """Each node has counted all that was sent on its topics. The recorder has what it was fast enough for of
    those on which anybody may speak."""
    refused: defaultdict[str, Counter[str]] = defaultdict(Counter)
    reasons: Counter[tuple[str, str, str, str]] = Counter()
    for entry in recording.messages(lambda topic: topic.startswith("journal/")):
        if isinstance(journal := entry.message, Journal):
            for told in refusals(journal):
                refused[journal.source][told.topic] += told.count
    recorded = Counter(entry.topic for entry in recording.messages())
    kept = keys_of(recording.scenario)
    wanted = wanted_by(recording.scenario)
    for name in sorted(sent):
        counts = {node: refused[node][name] for node, names in wanted.items() if name in names}
        why = {key: count for key, count in reasons.items() if key[1] == name}
        assert set(counts.values()) <= {sent[name]}, (name, sent[name], why)
        if name in kept and not topics.has_known_senders(name):
            assert recorded[name] > 0.5 * sent[name], name


def refusals(journal: Journal) -> Iterator[Refused]:
    for call in journal.calls:
        if call.name == topics.HOST_REFUSED and call.data is not None:
            told = codec.decode(call.name, call.data)
            assert isinstance(told, Refused)
            yield told


def wanted_by(scenario: Scenario) -> dict[str, set[str]]:
    """The topics that each node takes in from others."""
    return {
        name: {
            topic
            for topic in {*make(1).subscriptions, topics.PLAN}
            if topics.topic(topic).network != "host" and topics.sender_of(topic) != name
        }
        for name, make in factories(scenario).items()
    }
