"""`python -m benchmarks.chaos SEED ...`: run plans by their seeds and say what did not hold."""

import argparse
import sys
import tempfile
from pathlib import Path

from benchmarks.chaos.runs import describe, realtime, virtual


def main(arguments: list[str] | None = None) -> int:
    """Exit status 1 where something did not hold."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.chaos", description=__doc__)
    parser.add_argument("seeds", nargs="+", type=_seeds, metavar="SEED", help="a number, or a range as 0-499")
    parser.add_argument("--realtime", action="store_true", help="as real processes, not in virtual time")
    parser.add_argument("--speed", type=float, default=2.0, help="times real time (default: %(default)s)")
    parser.add_argument("--logs", type=Path, help="keep the recordings of real processes here")
    parser.add_argument("--quiet", action="store_true", help="say only what did not hold")
    asked = parser.parse_args(arguments)
    bad = 0
    for seed in (seed for some in asked.seeds for seed in some):
        with tempfile.TemporaryDirectory() as folder:
            log = (asked.logs or Path(folder)) / f"chaos-{seed}.mcap"
            figures, faults = realtime(seed, log, asked.speed) if asked.realtime else virtual(seed)
        bad += bool(faults)
        if faults or not asked.quiet:
            print(f"seed {seed}: {'; '.join(faults) or f'holds, done after {figures.duration_s:.1f} s'}")
        if faults or len(asked.seeds) == 1 == len(asked.seeds[0]):
            print("  " + describe(seed).replace("\n", "\n  "))
    return 1 if bad else 0


def _seeds(text: str) -> range:
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


if __name__ == "__main__":
    sys.exit(main())
