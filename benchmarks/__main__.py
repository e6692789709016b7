"""`python -m benchmarks [--quick] [NAME ...]`: all benchmarks, or some, as one table of ratios."""

import argparse
import os
import platform
import time
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from benchmarks.common import Row, show

NAMES = (
    "virtual_run",
    "verify",
    "range_kernel",
    "formation_tick",
    "recorder",
    "play",
    "viewer",
    "round_trip",
    "agent_footprint",
    "compensation",
    "planning",
)
"""Modules with a `TITLE` and `rows(quick)`, in the order of the table."""


class Benchmark(NamedTuple):
    """One module of the table."""

    title: str
    rows: Callable[[bool], list[Row]]


def benchmark(name: str) -> Benchmark:
    """The benchmark of one name of `NAMES`."""
    module = import_module(f"benchmarks.{name}")
    return Benchmark(module.TITLE, module.rows)


def main(arguments: list[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description="Ratios, each against a reference."
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; all by default")
    parser.add_argument("--quick", action="store_true", help="shorter and rougher")
    asked = parser.parse_args(arguments)
    if unknown := [name for name in asked.names if name not in NAMES]:
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(NAMES)}")
    print(machine(), "\n")
    begin = time.perf_counter()
    rows: list[Row] = []
    for name in asked.names or NAMES:
        chosen = benchmark(name)
        found = chosen.rows(asked.quick)
        show(chosen.title, found)
        rows += found
    judged = [row.met for row in rows if row.met is not None]
    print(f"{sum(judged)} of {len(judged)} budgets met, in {time.perf_counter() - begin:.0f} s")


def machine() -> str:
    """What the figures were measured on."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "eclipse-zenoh", "msgspec", "mcap"))
    cores = os.cpu_count()
    load = os.getloadavg()[0]
    return (
        f"{_cpu()}, {cores} cores, load {load:.1f}; {platform.system()} {platform.release()}\n"
        f"Python {platform.python_version()}, {packages}"
    )


def _cpu() -> str:
    try:
        with Path("/proc/cpuinfo").open() as file:
            names = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.machine()


if __name__ == "__main__":
    main()
