"""What the recorder process is put together from."""

from collections.abc import Sequence
from itertools import count
from pathlib import Path

from maniple.cli.machine import describe_machine
from maniple.cli.recording_options import RecordingOptions
from maniple.core.errors import RecordingError
from maniple.core.scenario.parse import to_json
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time, from_seconds
from maniple.host.clock import Anchor
from maniple.host.recorder import CHUNK_PERIOD
from maniple.host.recorder_drawing import Drawing
from maniple.recording.rolling import Ring, RollingWriter
from maniple.recording.split import PartsWriter, ViewerChannel
from maniple.recording.writer import Latched, RecordingWriter, part


def require_free_name(log: Path, next: bool) -> None:
    """See that the file is not there, unless the `next` part of it will do, and that its folder is.

    Raises:
        RecordingError: it can't be made.
    """
    if not log.parent.is_dir():
        raise RecordingError(f"can't create {log}: {log.parent} is not a directory")
    if log.exists() and not next:
        raise RecordingError(f"{log} exists already; a recording is never overwritten")


def writer_of(
    scenario: Scenario,
    log: Path,
    next: bool,
    clock: Anchor,
    options: RecordingOptions,
    keep_last_s: float | None,
) -> PartsWriter | RollingWriter:
    """What writes: parts in `log` or, where that may be, in the `next` part of it that does not exist; with
    `keep_last_s` only what is asked for.

    Raises:
        RecordingError: the file exists, or can't be made.
    """
    about = {
        **describe_machine(scenario, "realtime"),
        "anchor": str(clock.epoch_ns),
        "speed": repr(clock.speed),
        **options.metadata,
    }
    scenario_json = to_json(scenario)

    def written(path: Path, metadata: dict[str, str], latched: Sequence[Latched]) -> RecordingWriter:
        return RecordingWriter(
            path,
            scenario_json,
            metadata,
            prefix=scenario.network.prefix,
            now=clock.now(),
            compression=options.compression,
            chunk_period_ns=CHUNK_PERIOD,
            latched=latched,
        )

    numbers = count(1)

    def begin_part(latched: Sequence[Latched]) -> RecordingWriter:
        for number in numbers:
            path = part(log, number)
            try:
                return written(path, {**about, "part": str(number)}, latched)
            except RecordingError:
                if not path.exists() or (number == 1 and not next):
                    raise
        raise AssertionError

    def begin_kept(latched: Sequence[Latched]) -> RecordingWriter:
        for number in numbers:
            path = log.with_name(f"{log.stem}-kept-{number}{log.suffix}")
            if not path.exists():
                return written(path, about, latched)
        raise AssertionError

    takes = options.selection.takes
    if keep_last_s is None:
        return PartsWriter(begin_part, options.splits, takes)
    return RollingWriter(begin_kept, Ring(from_seconds(keep_last_s)), takes)


def drawing_of(
    scenario: Scenario,
    writer: PartsWriter | RollingWriter,
    options: RecordingOptions,
    epoch_ns: Time | None = None,
) -> Drawing | None:
    """What draws for viewers, unless that is not wanted; `epoch_ns` as for a `Viewer`."""
    if options.viz is False:
        return None
    from maniple.recording.viz import Viewer

    viewer = Viewer(scenario, epoch_ns)
    return Drawing(viewer, (ViewerChannel(*channel) for channel in viewer.channels), writer)
