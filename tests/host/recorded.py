"""Small recorded runs, and recordings that were tampered with."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from maniple.core.node import Node
from maniple.core.scenario.parse import to_json
from maniple.core.scenario.types import Scenario
from maniple.core.time import SECOND, VIRTUAL_EPOCH
from maniple.host.virtual import Factory, VirtualHost
from maniple.recording.reader import Recorded, read
from maniple.recording.writer import RecordingWriter
from tests.host.nodes import Answerer, Reporter, scenario_with

ROBOTS = ("r1", "r2")

METADATA = {"maniple": "0.1.0", "scenario": "hosts", "mode": "virtual", "seed": "0"}


def makers(robots: Iterable[str] = ROBOTS) -> Mapping[str, Factory]:
    """Two robots that report, and who answers them."""
    made: dict[str, Factory] = {"controller": lambda _: Answerer(ROBOTS)}
    return made | {name: (lambda _, name=name: Reporter(name)) for name in robots}


def record_run(
    path: Path, duration_s: int = 3, factories: Mapping[str, Factory] | None = None, **changes: Any
) -> Path:
    """A recorded run in virtual time, stopped in order."""
    scenario = scenario_with(**changes)
    makes = makers() if factories is None else factories
    nodes: list[Node] = [make(1) for make in makes.values()]
    with writer(path, scenario) as file:
        host = VirtualHost(
            nodes,
            scenario,
            lambda one, arrival: file.write(one.topic, one.data, arrival, one.stamp_ns, one.seq),
            makes,
        )
        host.start()
        host.run(host.now + duration_s * SECOND)
        host.stop(sorted(makes))
    return path


def rewrite(
    path: Path, to: Path, change: Callable[[Recorded], Iterable[Recorded]], scenario: Scenario | None = None
) -> Path:
    """A recording with each message replaced by what `change` makes of it; `scenario` instead of its own."""
    before = read(path)
    with writer(to, scenario or before.scenario, before.metadata) as file:
        for record in before.messages():
            for changed in change(record):
                file.write(*changed)
    return to


def without(topic: str, *seqs: int) -> Callable[[Recorded], Iterable[Recorded]]:
    """Leaves out messages of a topic, all where no number is given."""
    return lambda record: () if record.topic == topic and (not seqs or record.sequence in seqs) else (record,)


def flipped(topic: str, seq: int, place: int = -1) -> Callable[[Recorded], Iterable[Recorded]]:
    """Flips the lowest bit of one byte of one message."""

    def change(record: Recorded) -> Iterable[Recorded]:
        if (record.topic, record.sequence) != (topic, seq):
            return (record,)
        data = bytearray(record.data)
        data[place] ^= 1
        return (record._replace(data=bytes(data)),)

    return change


def writer(path: Path, scenario: Scenario, metadata: Mapping[str, str] = METADATA) -> RecordingWriter:
    """An empty recording of a run of a scenario."""
    return RecordingWriter(path, to_json(scenario), metadata, prefix="maniple", now=VIRTUAL_EPOCH)
