"""A random plan of faults: links, partitions, crashes, freezes, clocks, all from one seed."""

from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
from msgspec.structs import replace

from maniple.cli.loading import load
from maniple.core.layers import Layer
from maniple.core.scenario.types import (
    Burst,
    ClockError,
    Crash,
    Fault,
    Freeze,
    Partition,
    Placement,
    Scenario,
)
from maniple.core.streams import stream

SCENE = Path(__file__).parents[2] / "scenarios" / "chaos.toml"

FIRST_S, HEALED_S = 1.0, 20.0
"""Faults begin and end in between, since the start of the run."""

PATTERNS = ("robot/*/command", "robot/*/odometry", "robot/*/ranges", "robot/*/status", "formation/*", "*")

Random = np.random.Generator


def chaos(seed: int) -> Scenario:
    """The scene with a plan of its own for every seed, placed in one of the four ways."""
    scenario = load(SCENE, (), seed)
    random = stream(seed, "chaos")
    robots = [robot.id for robot in scenario.robots]
    placements: tuple[Layer, ...] = get_args(Layer)
    crashes = _crashes(random, robots)
    return replace(
        scenario,
        placement=Placement(robot_from=placements[seed % len(placements)]),
        faults=tuple(_fault(random, robots) for _ in range(random.integers(1, 5))),
        partitions=tuple(_partition(random, robots) for _ in range(random.integers(0, 3))),
        crashes=crashes,
        freezes=_freezes(random, robots, crashes),
        clocks=tuple(
            ClockError(
                node=node,
                offset_s=_rounded(random.uniform(-1e5, 1e5)),
                skew_ppm=_rounded(random.uniform(-200.0, 200.0)),
            )
            for node in ("controller", "simulator", *robots)
        ),
    )


def _fault(random: Random, robots: list[str]) -> Fault:
    """A rule with one to four kinds of trouble in one or two windows."""
    nodes = ["*", "r*", "controller", *robots]
    trouble: dict[str, Callable[[], float]] = {
        "latency_s": lambda: random.uniform(0.0, 1.5),
        "jitter_s": lambda: random.uniform(0.0, 0.8),
        "loss": lambda: random.uniform(0.05, 1.0),
        "duplicate": lambda: random.uniform(0.05, 0.5),
        "reorder": lambda: random.uniform(0.05, 0.5),
        "corrupt": lambda: random.uniform(0.01, 0.3),
        "rate_kbps": lambda: random.uniform(5.0, 200.0),
    }
    kinds = random.choice(list(trouble), size=random.integers(1, 5), replace=False).tolist()
    burst = Burst(enter=_rounded(random.uniform(0.01, 0.1)), leave=_rounded(random.uniform(0.05, 0.5)))
    quiet = Fault(
        source=str(random.choice(nodes)),
        destination=str(random.choice(nodes)),
        topic=str(random.choice(PATTERNS)),
        burst=burst if random.random() < 0.3 else None,
        windows=tuple(_span(random, 10.0) for _ in range(random.integers(1, 3))),
    )
    return replace(quiet, **{kind: _rounded(trouble[kind]()) for kind in kinds})


def _partition(random: Random, robots: list[str]) -> Partition:
    nodes = random.permutation(["controller", *robots]).tolist()
    begin, end = _span(random, 6.0)
    return Partition(
        groups=(tuple(nodes[: random.integers(1, len(nodes))]),), at_s=begin, for_s=_rounded(end - begin)
    )


def _crashes(random: Random, robots: list[str]) -> tuple[Crash, ...]:
    """Each of another node, so that nobody dies who is dead."""
    nodes = random.choice(["controller", *robots], size=random.integers(0, 3), replace=False).tolist()
    spans = [_span(random, 6.0) for _ in nodes]
    return tuple(
        Crash(node=node, at_s=begin, restart_after_s=_rounded(end - begin))
        for node, (begin, end) in zip(nodes, spans, strict=True)
    )


def _freezes(random: Random, robots: list[str], crashes: tuple[Crash, ...]) -> tuple[Freeze, ...]:
    """Of nodes that do not crash."""
    dying = {crash.node for crash in crashes}
    nodes = [node for node in ("controller", "simulator", *robots) if node not in dying]
    frozen = random.choice(nodes, size=random.integers(0, 3), replace=False).tolist()
    spans = [_span(random, 5.0) for _ in frozen]
    return tuple(
        Freeze(node=node, at_s=begin, for_s=_rounded(end - begin))
        for node, (begin, end) in zip(frozen, spans, strict=True)
    )


def _span(random: Random, longest_s: float) -> tuple[float, float]:
    """From and until, within the time of the faults."""
    lasts = random.uniform(0.2, longest_s)
    begin = random.uniform(FIRST_S, HEALED_S - lasts)
    return _rounded(begin), _rounded(begin + lasts)


def _rounded(value: float) -> float:
    return round(float(value), 2)
