"""`python -m benchmarks.evidence [--quick] [--images DIR]`: the tables of docs/evidence.md."""

import argparse
import sys
import time
from pathlib import Path

from benchmarks.evidence.study import FULL, QUICK, study
from benchmarks.evidence.tables import tables


def main(arguments: list[str] | None = None) -> None:
    """Compute and print; how long it took goes to standard error."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.evidence", description="Does the chain of triangles converge?"
    )
    parser.add_argument("--quick", action="store_true", help="fewer robots and starts")
    parser.add_argument("--images", type=Path, metavar="DIR", help="draw an example of each kind there too")
    asked = parser.parse_args(arguments)
    begin = time.perf_counter()
    found = study(QUICK if asked.quick else FULL)
    print(tables(found))
    if asked.images is not None:
        from benchmarks.evidence.figures import draw

        draw(found, asked.images)
    print(f"{time.perf_counter() - begin:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
