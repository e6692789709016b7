"""Messages to record, and recordings of them."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from maniple.core import codec, messages, topics
from maniple.core.time import MILLISECOND, VIRTUAL_EPOCH
from maniple.recording.reader import Recorded
from maniple.recording.writer import Compression, RecordingWriter

SCENARIO = b'{"name": "test"}'
METADATA = {"maniple": "0.1.0", "scenario": "test", "mode": "virtual", "seed": "7"}


Sent = Recorded
"""What is written is what is to be read; its fields are the arguments of `RecordingWriter.write`."""


def drive(seq: int, source: str = "r1", incarnation: int = 1) -> bytes:
    message = messages.Drive(
        source=source, incarnation=incarnation, seq=seq, stamp_ns=seq, u_mps=0.1, w_radps=0.0, active=True
    )
    return codec.encode(message)


def scan(seq: int, ranges: bytes) -> bytes:
    message = messages.Scan(
        source="simulator",
        incarnation=1,
        seq=seq,
        stamp_ns=seq,
        first_angle_rad=-1.5,
        increment_rad=0.1,
        range_min_m=0.0,
        range_max_m=8.0,
        mount=(0.0, 0.0, 0.0),
        ranges=ranges,
    )
    return codec.encode(message)


def traffic(ticks: int = 40) -> list[Sent]:
    """Drive commands and scans of two robots, 50 ms apart, each logged 1 ms after it was sent."""
    rng = np.random.default_rng(3)
    sent = []
    for tick in range(ticks):
        now = VIRTUAL_EPOCH + tick * 50 * MILLISECOND
        arrival = now + MILLISECOND
        for robot in ("r1", "r2"):
            ranges = messages.pack_floats(rng.uniform(0, 8, 31))
            sent.append(Sent(topics.drive(robot), drive(tick, robot), arrival, now, tick))
            sent.append(Sent(topics.scan(robot), scan(tick, ranges), arrival, now, tick))
    return sent


def record(path: Path, sent: Iterable[Sent], compression: Compression = "zstd") -> Path:
    """Write a recording, with a tick after each message."""
    with writer_to(path, compression) as writer:
        for message in sent:
            writer.write(*message)
            writer.tick(message.log_time_ns)
    return path


def writer_to(path: Path, compression: Compression = "zstd") -> RecordingWriter:
    return RecordingWriter(
        path, SCENARIO, METADATA, prefix="maniple", now=VIRTUAL_EPOCH, compression=compression
    )
