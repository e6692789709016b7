"""The recorder against the bare MCAP writer: same messages, chunks and compression, user + system time."""

import math
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TypeAlias

import msgspec
import numpy as np
from mcap.writer import CompressionType, Writer

from benchmarks.common import Budget, Row, best_of, cpu_s, show
from benchmarks.recorder_platoon import measure
from maniple.core import codec, messages, topics
from maniple.core.time import MILLISECOND, SECOND, VIRTUAL_EPOCH
from maniple.recording.reader import Recorded
from maniple.recording.writer import CHUNK_PERIOD, Compression, RecordingWriter, schema_of

TITLE = "Recorder, messages per CPU second"
BUDGET = Budget(0.9, "ratio", "at least")
LOST = Budget(0, "ours")

ROBOTS = tuple(f"r{i}" for i in range(1, 7))
SECONDS, QUICK_SECONDS = 20, 2
"""Of traffic."""
_BARE: dict[Compression, CompressionType] = {"none": CompressionType.NONE, "zstd": CompressionType.ZSTD}


Said: TypeAlias = tuple[str, str, messages.Message]
"""Topic, source and message."""


def rows(quick: bool = False) -> list[Row]:
    """One row for each compression; and the process, over Zenoh, with channels for viewers and without."""
    traffic = [
        message for second in range(QUICK_SECONDS if quick else SECONDS) for message in _second(second)
    ]
    made = [_row(traffic, compression, rounds=1 if quick else 5) for compression in ("zstd", "none")]
    for viz in (False, True):
        made += _platoon_rows(viz, quick)
    return made


def _platoon_rows(viz: bool, quick: bool) -> list[Row]:
    """Thirty robots, then for some seconds ten times as much: what of it is lost, and what it costs."""
    load = measure(viz, quick)
    with tempfile.TemporaryDirectory() as folder:
        bare = partial(_record_bare, Path(folder) / "bare.mcap", load.messages, "zstd")
        reference = cpu_s(bare)
    name = f"burst{', viz' if viz else ''}"
    each = 1e6 / len(load.messages)
    return [
        Row(name, load.lost, "lost", f"of {load.sent:,} sent", None, LOST),
        Row(f"{name}: a message", each * load.cpu_s, "us", "bare, from memory", each * reference),
        Row(f"{name}: memory", load.most_mb, "MB", "at most, of the process"),
    ]


def _row(traffic: list[Recorded], compression: Compression, rounds: int) -> Row:
    with tempfile.TemporaryDirectory() as folder:
        ours = partial(_rate, _record, Path(folder) / "ours.mcap", traffic, compression)
        bare = partial(_rate, _record_bare, Path(folder) / "bare.mcap", traffic, compression)
        value, reference = best_of(ours, bare, rounds, max)
    return Row(f"compression {compression}", value, "/s", "bare MCAP writer", reference, BUDGET)


def _rate(
    record: Callable[[Path, list[Recorded], Compression], None],
    path: Path,
    traffic: list[Recorded],
    compression: Compression,
) -> float:
    """Messages per CPU second."""
    spent = cpu_s(partial(record, path, traffic, compression))
    path.unlink()
    return len(traffic) / spent


def _record(path: Path, traffic: list[Recorded], compression: Compression) -> None:
    with RecordingWriter(path, b"{}", {}, prefix="maniple", compression=compression) as writer:
        for topic, data, log_time, publish_time, sequence in traffic:
            writer.write(topic, data, log_time, publish_time, sequence)
            writer.tick(log_time)


def _record_bare(path: Path, traffic: list[Recorded], compression: Compression) -> None:
    with path.open("xb") as file:
        writer = Writer(file, compression=_BARE[compression])
        writer.start()
        schemas = {
            kind: writer.register_schema(f"maniple.{kind.__name__}", "jsonschema", schema_of(kind))
            for kind in dict.fromkeys(row.type for row in topics.TOPICS)
        }
        channels: dict[str, int] = {}
        flush: Callable[[], None] = writer.flush
        due = traffic[0].log_time_ns + CHUNK_PERIOD
        for topic, data, log_time, publish_time, sequence in traffic:
            channel = channels.get(topic)
            if channel is None:
                schema = schemas[topics.topic(topic).type]
                channel = channels[topic] = writer.register_channel(f"maniple/{topic}", "msgpack", schema)
            writer.add_message(channel, log_time, data, publish_time, sequence)
            if log_time >= due:
                due = log_time + CHUNK_PERIOD
                flush()
        finish: Callable[[], None] = writer.finish
        finish()


def _second(second: int) -> list[Recorded]:
    """What six robots, simulator and controller say in one second, in sizes and kinds of numbers."""
    rng = np.random.default_rng(second)
    made: list[Recorded] = []
    for step in range(20):
        now, seq = VIRTUAL_EPOCH + second * SECOND + step * 50 * MILLISECOND, 20 * second + step
        for topic, source, message in _step(step, messages.Stamp(1, seq, now), rng):
            stamped = msgspec.structs.replace(message, source=source, incarnation=1, seq=seq, stamp_ns=now)
            made.append(Recorded(topic, codec.encode(stamped), now + MILLISECOND, now, seq))
    return made


def _step(step: int, stamp: messages.Stamp, rng: np.random.Generator) -> list[Said]:
    made = [said for robot in ROBOTS for said in _robot(step, robot, stamp, rng)]
    made.append((topics.TRUTH, "simulator", _truth(rng)))
    if step % 4 == 0:
        made += [(topics.journal(name), name, _journal(name, stamp, rng)) for name in ("controller", *ROBOTS)]
    return made


def _robot(step: int, robot: str, stamp: messages.Stamp, rng: np.random.Generator) -> Iterator[Said]:
    """20 Hz of odometry, drive and motion, 10 Hz of scans, ranges and commands."""
    a, b, c, d, e = rng.uniform(-1, 1, 5).tolist()
    odometry = messages.Odometry(
        frame_id=f"{robot}/1", x_m=a, y_m=b, psi_rad=c, u_mps=d, w_radps=e, applied=stamp
    )
    ticks = int(1e5 * a), int(1e5 * b)
    motion = messages.Motion(ticks=ticks, applied=(c, d), state="active", controllable=True)
    yield topics.odometry(robot), robot, odometry
    yield topics.drive(robot), robot, messages.Drive(u_mps=a, w_radps=b, active=True)
    yield topics.motion(robot), "simulator", motion
    if step % 2 == 0:
        scan = _scan(rng)
        yield topics.scan(robot), "simulator", scan
        yield topics.ranges(robot), robot, scan
        age = int(rng.integers(200 * MILLISECOND))
        command = messages.Command(layer="drive", values=(d, e), answers=stamp, inputs_age_ns=age)
        yield topics.command(robot), "controller", command


def _scan(rng: np.random.Generator) -> messages.Scan:
    """181 beams of 8 m in which two discs are seen, with 5 mm of noise in steps of 1 mm."""
    ranges = np.full(181, 8.0)
    for middle in rng.integers(20, 160, 2):
        disc = rng.uniform(0.5, 6) - 0.2 * np.cos(np.linspace(-1.5, 1.5, 24))
        ranges[middle - 12 : middle + 12] = np.round(disc + rng.normal(0, 0.005, 24), 3)
    return messages.Scan(
        first_angle_rad=-math.pi / 2,
        increment_rad=math.pi / 180,
        range_min_m=0.0,
        range_max_m=8.0,
        mount=(0.018, 0.0, 0.0),
        ranges=messages.pack_floats(ranges),
    )


def _truth(rng: np.random.Generator) -> messages.Truth:
    return messages.Truth(
        robots=ROBOTS,
        poses=messages.pack_floats(rng.uniform(size=(6, 3))),
        velocities=messages.pack_floats(rng.uniform(size=(6, 2))),
        clearances=messages.pack_floats(rng.uniform(size=6)),
        collisions=0,
    )


def _journal(name: str, stamp: messages.Stamp, rng: np.random.Generator) -> messages.Journal:
    """The calls into a node in 0.2 s: a dozen into an agent, forty into the controller."""
    checksums = rng.integers(2**32, size=40 if name == "controller" else 12).tolist()
    calls = tuple(
        messages.Call("message", stamp.stamp_ns + i, topics.motion("r1"), "simulator", 1, stamp.seq, crc32)
        for i, crc32 in enumerate(checksums)
    )
    return messages.Journal(calls=calls)


if __name__ == "__main__":
    show(TITLE, rows())
