"""Reference recordings of the project's scenes: how they are made, and checked against runs of today.

    python -m tests.references.scenes          show what changed, then replace the references that differ

`make references` does that, deliberately; nothing else writes them.
"""

import tempfile
from pathlib import Path
from typing import NamedTuple

from maniple.cli.loading import load
from maniple.cli.log.diff import show
from maniple.cli.machine import describe_machine
from maniple.cli.virtual import run_virtual
from maniple.core import topics
from maniple.core.errors import RecordingError
from maniple.core.scenario.parse import to_json
from maniple.recording.reader import Recorded, read
from maniple.recording.writer import RecordingWriter
from maniple.report.comparison_diff import Diff, compare
from maniple.report.comparison_tolerances import read_tolerances

HERE = Path(__file__).parent
SCENARIOS = HERE.parents[1] / "scenarios"
TOLERANCES = HERE / "tolerances.toml"


class Reference(NamedTuple):
    """One scene, or its first part."""

    name: str
    """Of the scenario file, and of the recording."""
    duration_s: float
    overrides: tuple[str, ...] = ()

    @property
    def path(self) -> Path:
        """The recording as it is to be."""
        return HERE / f"{self.name}.mcap"


REFERENCES = (
    Reference("paper-simulation-1", 50.0),
    Reference("paper-simulation-2", 45.0),
    Reference("paper-experiment-1", 50.0),
    Reference("paper-experiment-2", 50.0),
    Reference("chaos", 30.0, ("faults.0.loss=0.2", "faults.0.latency_s=0.05", "faults.0.jitter_s=0.04")),
    Reference("lost-robot", 40.0, ("crashes.0.at_s=12",)),
)

EVERY = 5
"""One of so many messages is kept, by its number."""


def is_kept(record: Recorded) -> bool:
    """Whether a message is part of a reference: how the robots moved, what they were told, what was seen."""
    name = record.topic
    kind = name in (topics.TRUTH, topics.FORMATION_STATE) or name.endswith("/command")
    return kind and record.sequence % EVERY == 0


def made(reference: Reference, folder: Path, *overrides: str) -> Path:
    """The recording of a scene as it runs today, in a folder."""
    scenario = load(SCENARIOS / f"{reference.name}.toml", (*reference.overrides, *overrides))
    whole, path = folder / f"{reference.name}-whole.mcap", folder / f"{reference.name}.mcap"
    metadata = describe_machine(scenario, "virtual")
    run_virtual(scenario, whole, metadata, reference.duration_s, lambda _: None)
    with RecordingWriter(path, to_json(scenario), metadata, prefix=scenario.network.prefix) as writer:
        for record in read(whole).messages():
            if is_kept(record):
                writer.write(*record)
    return path


def compared(reference: Reference, today: Path) -> Diff:
    """How today's recording differs from the reference."""
    return compare(read(reference.path), read(today), read_tolerances(TOLERANCES)).diff


def check(reference: Reference, folder: Path, *overrides: str) -> None:
    """Run a scene in a folder, and see that it is as the reference has it.

    Raises:
        AssertionError: it is not; says which command shows the differences.
    """
    today = made(reference, folder, *overrides)
    if not (found := compared(reference, today)).same:
        topics_off = ", ".join(topic.topic for topic in found.messages if not topic.same)
        raise AssertionError(
            f"{reference.name} does not run as it did, by {topics_off}; see\n  {command(reference, today)}\n"
            "and, if that is as it should be, `make references`"
        )


def command(reference: Reference, today: Path) -> str:
    """What shows the differences as tables and pictures."""
    plots = today.with_name(f"{reference.name}-plots")
    return f"maniple log diff {reference.path} {today} --tolerances {TOLERANCES} --plot {plots}"


def main() -> None:
    """Show what changed, and replace the references that differ by more than their tolerances."""
    from rich.console import Console

    console = Console(width=120)
    folder = Path(tempfile.mkdtemp(prefix="maniple-references-"))
    for reference in REFERENCES:
        today = made(reference, folder)
        try:
            found = compared(reference, today)
        except RecordingError as error:
            console.print(f"{reference.name}: new ({error})", highlight=False, soft_wrap=True)
        else:
            if found.same and not found.scenario:
                console.print(f"{reference.name}: as it was", highlight=False)
                continue
            show(found, console)
            console.print(command(reference, today), highlight=False, soft_wrap=True)
        reference.path.write_bytes(today.read_bytes())
        console.print(f"{reference.name}: replaced, {reference.path.stat().st_size} bytes", highlight=False)


if __name__ == "__main__":
    main()
