"""`maniple.run`: from Python what `maniple run` does on the command line."""

import datetime
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from maniple.cli.extensions import require_extras, require_layers
from maniple.cli.loading import completed, load
from maniple.cli.machine import describe_machine
from maniple.cli.outcome import Outcome, recordings_of
from maniple.cli.progress import Progress
from maniple.cli.realtime import run_realtime
from maniple.cli.recording_options import EVERYTHING, RecordingOptions, notices
from maniple.cli.virtual import run_virtual
from maniple.cli.wall_clock import require_simulated
from maniple.core.errors import ArgumentError, RecordingError, ScenarioError
from maniple.core.scenario.types import Scenario
from maniple.host.clock import FASTEST, SLOWEST
from maniple.host.recorder import keys_of
from maniple.host.recorder_space import Space
from maniple.recording.info import describe
from maniple.report.summary import Errors, MessageCounts, Percentiles, Summary


class Result(msgspec.Struct, frozen=True):
    """What a run amounts to; what `maniple run --json` prints."""

    scenario: str
    mode: str
    """ "realtime" or "virtual"."""
    seed: int
    robots: int
    duration_s: float
    """Simulated time until the end of the task, or of the run."""
    wall_s: float
    real_time_factor: float
    """Simulated time over wall time."""
    completed: bool
    """Whether the task's end was reached."""
    collisions: int | None
    """Onsets of contact, ground truth; None without any."""
    min_clearance_m: float | None
    """Smallest distance from a robot's outline to anything, likewise."""
    final_error: Errors
    """Ground truth against the desired formation, mean of the last second, over the triangles of which every
    robot has ground truth."""
    peak_error: Errors
    estimated_final_error: Errors
    """The final error as the controller sees it."""
    messages: MessageCounts
    command_age_ms: Percentiles
    """Of what the robots acted on, by their own clocks."""
    log: str
    """The recording, or its first part."""
    lost_robots: list[str] = []
    """Robots that the controller ever gave up as lost."""
    odometry_drift_m: float | None = None
    """Largest distance, at the end, from where a control point is to where dead reckoning puts it."""
    without_truth: list[str] = []
    """Robots that no ground truth tells of: collisions, clearance and true errors are of the others."""
    unrecorded: int = 0
    """Messages that the recording lacks, by their sequence numbers."""
    logs: list[str] = []
    """All parts of the recording, in order: a recorder that is started again goes on in a new one."""
    restarts: dict[str, int] = {}
    """How often each process was started again."""
    interrupted: bool = False

    @property
    def ok(self) -> bool:
        """Whether the task was completed without a collision that is known of."""
        return self.completed and not self.collisions


def run(
    scenario: Scenario | Path | str,
    *,
    virtual: bool = False,
    speed: float = 1.0,
    duration_s: float | None = None,
    seed: int | None = None,
    overrides: Sequence[str] = (),
    log: Path | str | None = None,
    keep_alive: bool = False,
    recording: RecordingOptions = EVERYTHING,
    on_progress: Callable[[Progress], None] = lambda _: None,
    on_notice: Callable[[str], None] = lambda _: None,
) -> Result:
    """Run a scenario to the end of its task, or for `duration_s` of simulated time, and record it.

    `scenario` is a file or a `Scenario`; `overrides` are as `--set` takes them ("controller.kappa=0.3").
    With `virtual` all nodes run in this process in virtual time, else each in a process of its own over
    Zenoh at `speed` times the wall clock. An existing `log` is not overwritten; by default a new file in
    `logs/`. `recording` says how it is recorded. With `keep_alive` every process that dies is started again,
    but for the simulator and vehicles. `on_notice` gets a line for each process that dies, freezes or comes
    back, for what the recorder, drivers and vehicles say, and for what can't happen in virtual time. A
    scenario in which a robot has a driver of its own runs by the wall clock only.

    Raises:
        ArgumentError: speed or duration is not valid, also for the drivers of its robots, or there are no
            processes to keep alive.
        ScenarioError: the scenario is not valid.
        MissingExtraError: a driver needs what is not installed.
        RecordingError: the recording can't be written.
        RunError: a process of the run failed; the recording up to then is there.
    """
    _require_valid(virtual, speed, duration_s, keep_alive)
    given = None if log is None else _given_path(Path(log))
    resolved = _resolved(scenario, overrides, seed)
    if virtual or speed != 1.0:
        require_simulated(resolved, "virtual time" if virtual else f"speed = {speed:g}")
    require_layers(resolved)
    require_extras(resolved)
    _require_recordable(resolved, virtual, recording)
    for notice in notices(recording, resolved) if virtual else ():  # else the recorder says it
        on_notice(notice)
    path = given or _new_path(f"{resolved.name}-{'virtual-' if virtual else ''}")
    Space(path.parent, recording.min_free_bytes).require()
    begin = time.perf_counter()
    unrecorded = 0
    if virtual:
        metadata = describe_machine(resolved, "virtual")
        outcome = run_virtual(
            resolved, path, metadata, duration_s, on_progress, on_notice, recording=recording
        )
    else:
        outcome = run_realtime(
            resolved, path, speed, duration_s, on_progress, on_notice, keep_alive, recording
        )
        unrecorded = sum(describe(one).missing for one in recordings_of(outcome.logs))
    wall_s = time.perf_counter() - begin
    return _result(resolved, "virtual" if virtual else "realtime", outcome, path, wall_s, unrecorded)


def _require_valid(virtual: bool, speed: float, duration_s: float | None, keep_alive: bool) -> None:
    if not SLOWEST <= speed <= FASTEST:
        raise ArgumentError(f"speed = {speed:g}: must be from {SLOWEST:g} to {FASTEST:g}")
    if virtual and speed != 1.0:
        raise ArgumentError(
            f"speed = {speed:g}: virtual time goes as fast as it can; speed is for real processes"
        )
    if virtual and keep_alive:
        raise ArgumentError("keep alive: there are no processes in virtual time; the scenario says who dies")
    if duration_s is not None and not 0 < duration_s < 1e9:
        raise ArgumentError(f"duration = {duration_s:g} s: must be above 0 and less than 1e9")


def _require_recordable(scenario: Scenario, virtual: bool, recording: RecordingOptions) -> None:
    """See that there will be what the figures of the run are made of."""
    if virtual:
        return
    wants, takes = Summary(scenario).wants, recording.selection.takes
    if lacking := sorted(key for key in keys_of(scenario) if wants(key) and not takes(key)):
        raise ArgumentError(
            f"{', '.join(lacking[:3])}{' ...' if lacking[3:] else ''} must be recorded: "
            "the figures of a run in realtime are made from that"
        )


def _resolved(scenario: Scenario | Path | str, overrides: Sequence[str], seed: int | None) -> Scenario:
    if not isinstance(scenario, Scenario):
        return load(Path(scenario), overrides, seed)
    if overrides:
        raise ScenarioError(
            "overrides are for scenario files; change a Scenario with msgspec.structs.replace"
        )
    return completed(scenario if seed is None else msgspec.structs.replace(scenario, seed=seed))


def _given_path(path: Path) -> Path:
    """Where the recording is asked to be; found out now that it can't, not by the recorder later."""
    try:
        there, folder = path.exists(), path.parent.is_dir()
    except OSError as error:
        raise RecordingError(f"can't create {path}: {error.strerror}") from None
    if there:
        raise RecordingError(f"{path} exists already; a recording is never overwritten")
    if not folder:
        raise RecordingError(f"can't create {path}: {path.parent} is not a directory")
    return path


def _new_path(stem: str) -> Path:
    """A new file in `logs/`; the process id is in its name, so that runs that start together do not clash."""
    folder = Path("logs")
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise RecordingError(f"can't create {folder.absolute()}: {error.strerror}") from None
    stem += f"{datetime.datetime.now():%Y%m%d-%H%M%S}-{os.getpid()}"
    names = (stem, *(f"{stem}-{number}" for number in range(2, 10_000)))
    return next(path for name in names if not (path := folder / f"{name}.mcap").exists())


def _result(
    scenario: Scenario, mode: str, outcome: Outcome, path: Path, wall_s: float, unrecorded: int
) -> Result:
    figures = outcome.figures
    return Result(
        scenario=scenario.name,
        mode=mode,
        seed=scenario.seed,
        robots=len(scenario.robots),
        wall_s=round(wall_s, 3),
        real_time_factor=round(figures.duration_s / wall_s, 3),
        log=str(path),
        unrecorded=unrecorded,
        logs=[str(log) for log in outcome.logs],
        restarts=dict(outcome.restarts),
        interrupted=outcome.interrupted,
        **msgspec.structs.asdict(figures),
    )
