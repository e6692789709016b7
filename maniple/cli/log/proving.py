"""Runs the nodes of a recording again, on all cores."""

import os
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from multiprocessing import get_context, parent_process
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from maniple.cli.extensions import require_layers
from maniple.cli.machine import describe_machine
from maniple.cli.nodes import factories
from maniple.core.errors import ArgumentError, RunError
from maniple.core.node import Node
from maniple.core.scenario.check import require_valid
from maniple.core.scenario.parse import digest_of
from maniple.core.scenario.types import Scenario
from maniple.core.time import to_seconds
from maniple.host.verification import Census, Proof, Speaker, census, problems_of, prove
from maniple.recording.absence import Absences
from maniple.recording.compare import Tolerance
from maniple.recording.reader import Recording, read
from maniple.recording.recover import RECOVERED_NAME

SMALL = 2 << 20
"""Bytes of a recording for which it is not worth to start processes."""

CENTRAL = ("simulator", "controller")
"""Nodes that have to do with all robots."""

POLL_S = 0.2
"""How soon a request to stop is seen, and what was done is told."""


class StoppedError(Exception):
    """It was asked to stop."""


class Progress(NamedTuple):
    """How far it is."""

    done: int
    nodes: int


class Verification(msgspec.Struct, frozen=True, kw_only=True):
    """What came of running the nodes of a recording again."""

    file: str
    holds: bool
    """Whether everything was proved."""
    scenario: str
    mode: str
    duration_s: float
    nodes: tuple[str, ...]
    """That were to be run again."""
    lives: tuple[Proof, ...]
    problems: tuple[str, ...]
    """What keeps it from being proved, beside what the lives say."""
    notes: tuple[str, ...]
    """What else there is to know."""
    others: tuple[Speaker, ...]
    """Who said something that can't be run again: operators, the router, and others."""
    of_hosts: int
    """Messages that hosts made and not nodes: journals, counters of links, fault decisions."""
    tolerance: Tolerance


class Order(NamedTuple):
    """What is to be done."""

    file: Path
    tolerance: Tolerance
    trace: int


def verify(
    order: Order,
    nodes: Sequence[str],
    jobs: int | None,
    stopped: Callable[[], bool],
    on_progress: Callable[[Progress], None],
) -> Verification:
    """Run all nodes of a recording again, or these, and compare what they send with what is recorded.

    Raises:
        ArgumentError: a node is not in the scenario.
        RecordingError: the recording can't be read.
        ScenarioError: a layer of its scenario is not installed here.
        RunError: a process died.
        StoppedError: `stopped` said so.
    """
    recording = read(order.file)
    scenario = recording.scenario
    known = tuple(makers_of(scenario))
    if unknown := [name for name in nodes if name not in known]:
        raise ArgumentError(
            f"--node {unknown[0]}: the recorded scenario has no such node; it has {', '.join(known)}"
        )
    chosen = tuple(name for name in known if not nodes or name in nodes)
    count = jobs or (1 if _size(recording) < SMALL else len(os.sched_getaffinity(0)))
    if count == 1:
        said, proofs = _one_by_one(order, recording, chosen, stopped, on_progress)
    else:
        said, proofs = _side_by_side(order, chosen, count, stopped, on_progress)
    return _summed_up(order, recording, chosen, said, proofs)


def makers_of(scenario: Scenario) -> Mapping[str, Callable[[int], Node]]:
    """What makes the nodes of a recorded scenario.

    Raises:
        ScenarioError: it is not valid here, or a layer is not installed.
    """
    require_valid(scenario)
    require_layers(scenario)
    return factories(scenario)


def _summed_up(
    order: Order, recording: Recording, nodes: tuple[str, ...], said: Census, proofs: tuple[Proof, ...]
) -> Verification:
    metadata = recording.metadata
    problems = [*problems_of(said, proofs, nodes), *_contradictions(recording)]
    members = tuple(factories(recording.scenario))
    rank = {name: place for place, name in enumerate(members)}
    return Verification(
        file=str(order.file),
        holds=not problems and all(proof.holds for proof in proofs),
        scenario=metadata.get("scenario", ""),
        mode=metadata.get("mode", ""),
        duration_s=to_seconds(recording.end_ns - recording.start_ns),
        nodes=nodes,
        lives=tuple(sorted(proofs, key=lambda one: (rank[one.node], one.incarnation))),
        problems=tuple(problems),
        notes=tuple(_notes(recording, nodes, said, proofs)),
        others=tuple(one for one in said.speakers if one.source not in members),
        of_hosts=sum(one.of_host for one in said.speakers if one.source in members),
        tolerance=order.tolerance,
    )


def _contradictions(recording: Recording) -> list[str]:
    """Where what the recording says of its scenario is not what is attached."""
    scenario = recording.scenario
    attached = {"scenario": scenario.name, "seed": str(scenario.seed), "prefix": scenario.network.prefix}
    return [
        f"it says that its {name} is {said}, the attached scenario says {value}"
        for name, value in attached.items()
        if (said := recording.metadata.get(name, value)) != value
    ]


def _notes(recording: Recording, nodes: Sequence[str], said: Census, proofs: Sequence[Proof]) -> list[str]:
    """What may explain what was found."""
    scenario, metadata = recording.scenario, recording.metadata
    here = describe_machine(scenario, metadata.get("mode", ""))
    off = [name for name, value in here.items() if metadata.get(name, "") != value]
    notes = []
    if "maniple" in off:
        made_by = metadata.get("maniple", "unknown")
        notes.append(f"the recording was made by version {made_by}, this is {here['maniple']}")
    if kinds := [name for name in ("python", "numpy", "machine", "cpu_features") if name in off]:
        told = ", ".join(_contrast(name, metadata.get(name, "unknown"), here[name]) for name in kinds)
        notes.append(
            f"it was made on another machine type ({told}): rounding may differ there; use --tolerance"
        )
    attached = digest_of(recording.scenario_json)
    if others := [
        f"{one.node} (life {one.incarnation})" for one in proofs if one.scenario not in ("", attached)
    ]:
        notes.append(f"{', '.join(others)} ran another scenario than the one in the recording")
    if not recording.complete:
        notes.append("the recorder did not finish the recording: what it proves ends where that does")
    notes += [
        f"it was recovered from a file of which {lost} bytes were lost"
        for part in recording.all_metadata
        if (lost := part.get(RECOVERED_NAME, {}).get("lost_bytes", "0")) != "0"
    ]
    if recording.lacking:
        notes.append(f"{recording.lacking}: what is proved ends before that")
    notes += recording.passed_over
    notes += [
        f"left out on purpose: {said}"
        for said in Absences(recording.all_metadata, recording.start_ns).texts(recording.start_ns)
    ]
    speakers = {one.source for one in said.speakers}
    proved = {(proof.node, proof.incarnation) for proof in proofs}
    for name in nodes:
        if name not in speakers:
            notes.append(f"{name}: there is nothing of it in the recording")
    for one in said.speakers:
        if one.source in nodes and (one.source, one.incarnation) not in proved:
            notes.append(
                f"{one.source} (life {one.incarnation}): it left no journal; its messages "
                f"({one.messages - one.of_host}) are unproved"
            )
    if said.disordered:
        notes.append(f"{said.disordered} messages are there again, or after later ones of their sender")
    if said.headless:
        notes.append(f"{said.headless} messages had no valid header when they arrived: they are nobody's")
    return notes


def _contrast(name: str, there: str, here: str) -> str:
    """How two machines differ; of a list only that."""
    if name != "cpu_features":
        return f"{name} {there}, here {here}"
    more, less = set(there.split()) - set(here.split()), set(here.split()) - set(there.split())
    parts = (("only there", more), ("only here", less))
    told = [f"{where} {' '.join(sorted(which))}" for where, which in parts if which]
    return f"CPU features {', '.join(told)}"


def _size(recording: Recording) -> int:
    return sum(path.stat().st_size for path in recording.paths)


def _one_by_one(
    order: Order,
    recording: Recording,
    nodes: Sequence[str],
    stopped: Callable[[], bool],
    on_progress: Callable[[Progress], None],
) -> tuple[Census, tuple[Proof, ...]]:
    """All in this process."""

    def watch() -> None:
        if stopped():
            raise StoppedError

    on_progress(Progress(0, len(nodes)))
    watch()
    return census(recording, watch), _prove(order, recording, nodes, watch)


def _side_by_side(
    order: Order,
    nodes: Sequence[str],
    count: int,
    stopped: Callable[[], bool],
    on_progress: Callable[[Progress], None],
) -> tuple[Census, tuple[Proof, ...]]:
    """In `count` processes, which end when this one does."""
    context = get_context("spawn")
    stop = context.Event()
    with ProcessPoolExecutor(count, context, _begin, (stop,)) as pool:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # until they ignore them
        try:
            work = {group: pool.submit(_prove_here, order, group) for group in groups(nodes, count)}
            counting = pool.submit(_count_here, order)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        try:
            left: set[Future[Any]] = {counting, *work.values()}
            while left:
                done = sum(len(group) for group, one in work.items() if one.done())
                on_progress(Progress(done, len(nodes)))
                left = wait(left, POLL_S, FIRST_COMPLETED).not_done
                if stopped():
                    raise StoppedError
            proofs = [proof for one in work.values() for proof in one.result()]
            return counting.result(), tuple(proofs)
        except BrokenProcessPool:
            raise RunError("a process that ran nodes again died; --jobs 1 takes the least memory") from None
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def groups(nodes: Sequence[str], count: int) -> list[tuple[str, ...]]:
    """Nodes in up to `count` groups that take about as long: the simulator and the controller each do about
    as much as all agents together."""
    robots = sum(node not in CENTRAL for node in nodes)
    loads = [(max(robots, 1) if node in CENTRAL else 1, node) for node in nodes]
    found: list[list[str]] = [[] for _ in range(min(count, len(nodes)))]
    work = [0] * len(found)
    for load, node in sorted(loads, key=lambda one: -one[0]):
        least = work.index(min(work))
        found[least].append(node)
        work[least] += load
    return [tuple(group) for group in found]


_stop: list[Event] = []


def _begin(stop: Event) -> None:
    """What a process does first: it ends with its parent, and hears of an interrupt from it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    _stop.append(stop)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if (parent := parent_process()) is not None:
        parent.join()
        os._exit(1)


def _watch() -> None:
    if _stop[0].is_set():
        raise StoppedError


def _prove_here(order: Order, nodes: Sequence[str]) -> tuple[Proof, ...]:
    return _prove(order, _opened(order.file), nodes, _watch)


def _count_here(order: Order) -> Census:
    return census(_opened(order.file), _watch)


def _prove(
    order: Order, recording: Recording, nodes: Sequence[str], watch: Callable[[], None]
) -> tuple[Proof, ...]:
    makers = factories(recording.scenario)
    return prove(recording, {node: makers[node] for node in nodes}, order.tolerance, order.trace, watch)


@lru_cache(1)
def _opened(file: Path) -> Recording:
    """The recording, found out about once in each process that was started for it."""
    return read(file)
