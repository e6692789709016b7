"""A run in virtual time, in this process."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path

from maniple.cli.interrupt import on_interrupt
from maniple.cli.nodes import RUNDOWN_S, factories, time_limit_s
from maniple.cli.outcome import Outcome
from maniple.cli.progress import Progress, ProgressWatch
from maniple.cli.recording_options import EVERYTHING, RecordingOptions
from maniple.core import codec, topics
from maniple.core.edges import preflight_asked
from maniple.core.envelope import Envelope
from maniple.core.errors import ScenarioError
from maniple.core.messages import FormationState
from maniple.core.scenario.check_faults import PROCESSES
from maniple.core.scenario.parse import to_json
from maniple.core.scenario.types import Scenario
from maniple.core.time import Time, from_seconds
from maniple.host.recorder_drawing import Drawing
from maniple.host.virtual import VirtualHost
from maniple.recording.split import PartsWriter
from maniple.recording.writer import Latched, RecordingWriter, part
from maniple.report.summary import Summary


def run_virtual(
    scenario: Scenario,
    log: Path,
    metadata: Mapping[str, str],
    duration_s: float | None,
    on_progress: Callable[[Progress], None],
    on_notice: Callable[[str], None] = lambda _: None,
    inputs: Sequence[tuple[Time, Envelope]] = (),
    recording: RecordingOptions = EVERYTHING,
) -> Outcome:
    """Run to the end of the task, or of `duration_s`; `on_notice` gets what the scenario asks for in vain.
    `inputs` are what operators say, and when. `log` must not be there.

    Raises:
        ScenarioError: the platoon would wait for ever for somebody to test its emergency stop.
        RecordingError: the recording can't be written.
    """
    tested = any(envelope.topic == topics.STOP for _, envelope in inputs)
    if preflight_asked(scenario) and scenario.preflight.estop and not tested:
        raise ScenarioError(
            "preflight.estop = true: in virtual time nobody tests the emergency stop, so the platoon would "
            "wait for ever; set preflight.estop = false, or run it without --virtual"
        )
    for notice in _without_process(scenario):
        on_notice(notice)
    summary = Summary(scenario)
    watch = ProgressWatch(scenario)
    takes = recording.selection.takes
    uses: dict[str, tuple[bool, bool]] = {}
    drawing: Drawing | None = None
    interrupted = False

    def tap(envelope: Envelope, arrival: Time) -> None:
        topic = envelope.topic
        found = uses.get(topic)
        if found is None:
            found = uses[topic] = takes(topic), summary.wants(topic)
        taken, wanted = found
        if taken:
            writer.write(topic, envelope.data, arrival, envelope.stamp_ns, envelope.seq)
            if drawing is not None:
                drawing.draw(topic, envelope.data, arrival, 0)
        writer.tick(arrival)
        if wanted:
            message = codec.decode(topic, envelope.data)
            summary.add(message)
            watch.add(message)
            if isinstance(message, FormationState):
                on_progress(watch.progress())
                if message.phase == "done":
                    host.halt()

    def interrupt() -> None:
        nonlocal interrupted
        interrupted = True
        host.halt()

    makers = factories(scenario)
    host = VirtualHost([make(1) for make in makers.values()], scenario, tap, makers, inputs)
    scenario_json = to_json(scenario)
    numbers = count(1)

    def begin(latched: Sequence[Latched]) -> RecordingWriter:
        number = next(numbers)
        about = {**metadata, **recording.metadata, **({"part": str(number)} if number > 1 else {})}
        return RecordingWriter(
            part(log, number),
            scenario_json,
            about,
            prefix=scenario.network.prefix,
            now=host.now,
            compression=recording.compression,
            latched=latched,
        )

    with contextlib.closing(PartsWriter(begin, recording.splits)) as writer, on_interrupt(interrupt):
        if recording.viz:
            from maniple.cli.recorder_parts import drawing_of

            drawing = drawing_of(scenario, writer, recording, host.now)
        host.start()
        host.run(host.now + from_seconds(time_limit_s(scenario, duration_s)))
        host.stop(["controller"])
        host.stop(robot.id for robot in scenario.robots)
        host.run(host.now + from_seconds(RUNDOWN_S))
        host.stop(["simulator"])
    if drawing is not None and (text := drawing.summary()):
        on_notice(text)
    return Outcome(summary.figures(), interrupted, tuple(writer.paths), {})


def _without_process(scenario: Scenario) -> Iterator[str]:
    """Crashes and freezes of what is not there in virtual time."""
    named = [(f"crashes[{index}]", crash.node) for index, crash in enumerate(scenario.crashes)]
    named += [(f"freezes[{index}]", freeze.node) for index, freeze in enumerate(scenario.freezes)]
    for where, node in named:
        if node in PROCESSES:
            yield f"{where} does nothing: there is no {node} in virtual time; run it without --virtual"
