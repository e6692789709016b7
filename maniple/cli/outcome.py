"""What became of a run: its figures, from a recording that may have several parts."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from maniple.core.errors import RecordingError
from maniple.core.scenario.types import Scenario
from maniple.recording.reader import Recording, read
from maniple.report.summary import RunFigures, Summary
from maniple.report.true_time import epoch_of


class Outcome(NamedTuple):
    """What became of a run."""

    figures: RunFigures
    interrupted: bool
    logs: tuple[Path, ...]
    """The parts of the recording, in order; none where it was interrupted before there was one."""
    restarts: Mapping[str, int]
    """How often each process was started again."""


def figures_of(logs: Sequence[Path], scenario: Scenario) -> RunFigures:
    """The figures of a run from the parts of its recording.

    Raises:
        RecordingError: they can't be read.
    """
    recordings = recordings_of(logs)
    summary = Summary(scenario, *map(epoch_of, recordings[:1]))
    for recording in recordings:
        for entry in recording.messages(summary.wants):
            if entry.message is not None:
                summary.add(entry.message)
    return summary.figures()


def recordings_of(logs: Sequence[Path]) -> list[Recording]:
    """The parts of a recording that can be opened: a recorder may be killed before its first message.

    Raises:
        RecordingError: there are some, but none can.
    """
    opened: list[Recording] = []
    problem: RecordingError | None = None
    for log in logs:
        if any(log in recording.paths for recording in opened):
            continue
        try:
            opened.append(read(log))
        except RecordingError as error:
            problem = problem or error
    if problem and not opened:
        raise problem
    return opened
