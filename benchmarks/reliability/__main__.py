"""`python -m benchmarks.reliability`: all cases, and the table of docs/reliability.md."""

import argparse
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from benchmarks.__main__ import machine
from benchmarks.reliability.analysis import Analysis, Found
from benchmarks.reliability.runs import CASES, FROZEN_S, Case, run

DOC = Path(__file__).parents[2] / "docs" / "reliability.md"
BEGIN, END = "<!-- measured: begin -->\n", "<!-- measured: end -->\n"
HEADINGS = (
    "what",
    "affected stand after (s)",
    "bound (s)",
    "reference stands after (s)",
    "back after (s)",
    "under way again (s)",
    "oldest command (s)",
    "collisions",
    "held",
)


def main() -> None:
    """Measure, print, and write if asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reliability", description=__doc__)
    parser.add_argument("--rounds", type=int, default=3, help="how often each case is done (default: 3)")
    parser.add_argument("--speed", type=float, default=1.0, help="times real time (default: 1)")
    parser.add_argument("--write", action="store_true", help=f"write the table into {DOC.name}")
    asked = parser.parse_args()
    found: list[Found] = []
    for _ in range(asked.rounds):
        with tempfile.TemporaryDirectory() as folder:
            done = run(CASES, Path(folder), asked.speed)
            found += Analysis(done).found(done.events)
    text = f"{table(found)}\n{about(asked.rounds, asked.speed)}"
    print(text)
    if asked.write:
        DOC.write_text(with_part(DOC.read_text(), text))
    raise SystemExit(0 if all(one.ok for one in found) else 1)


def table(found: Sequence[Found]) -> str:
    """The worst of each case as a table in Markdown."""
    cases: defaultdict[Case, list[Found]] = defaultdict(list)
    for one in found:
        cases[one.case].append(one)
    lines = [HEADINGS, ["---"] * len(HEADINGS), *(_row(case, many) for case, many in cases.items())]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def about(rounds: int, speed: float) -> str:
    """How the table was made."""
    cpu = machine().splitlines()[0].replace(";", ",")
    return (
        f"The worst of {rounds} rounds each; a process is frozen for {FROZEN_S:g} s; speed {speed:g}. "
        f"Measured on {cpu}.\n"
    )


def with_part(text: str, part: str) -> str:
    """A document with the part between the marks replaced."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError("the document has no marks")
    return f"{before}{begin}{part}{end}{after}"


def _row(case: Case, found: Sequence[Found]) -> list[str]:
    stood = [one.stood_s for one in found if one.stood_s is not None]
    reference = [one.reference_s for one in found if one.reference_s is not None]
    free = case.who == "recorder"
    return [
        f"{case.how} {case.who}",
        f"{max(stood):.2f}" if stood and not free else "go on",
        "" if free else f"{max(one.bound_s for one in found):.2f}",
        f"{max(reference):.2f}" if reference else "goes on",
        f"{max(one.back_s for one in found):.2f}",
        f"{max(one.recovered_s for one in found):.2f}",
        f"{max(one.age_s for one in found):.2f}",
        f"{sum(one.collisions for one in found)}",
        "yes" if all(one.ok for one in found) else "NO",
    ]


if __name__ == "__main__":
    main()
