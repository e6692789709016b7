"""Saves what is whole in a file that a crash or a copy left behind."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import msgspec
from mcap.records import Attachment

from maniple.core.errors import ArgumentError, RecordingError
from maniple.core.scenario.types import Scenario
from maniple.recording.reader import damage_of, topic_under
from maniple.recording.rewrite import Rewriter, beside
from maniple.recording.scan import DAMAGE, Damage, Layout, open_file, read_chunk, scan
from maniple.recording.tally import GAPS_NAME, Stream
from maniple.recording.writer import METADATA_NAME, SCENARIO_NAME

RECOVERED_NAME = "maniple.recovered"
"""The metadata record that says what was lost: `lost_bytes`, `lost_chunks`, `lost_messages` and `lost`, a
JSON list of texts."""


class Recovered(msgspec.Struct, frozen=True, kw_only=True):
    """What was saved."""

    file: str
    out: str
    complete: bool
    """Whether the file had been finished by its recorder."""
    messages: int
    """Saved."""
    viewer_messages: int
    """Saved of what was derived for viewers."""
    chunks: int
    lost_bytes: int
    """Of the file: what could not be read."""
    lost_chunks: int
    """Whose content is not what was written; what else was in unreadable stretches is not known."""
    lost_messages: int
    """Whose channel is not known any more."""
    lost: tuple[str, ...]
    """All that is damaged."""
    missing: int
    """Messages that the new file lacks, by sequence number and the senders' journals."""
    streams: tuple[Stream, ...]
    """Those of which something is missing."""


def recover(file: Path, out: Path | None = None, scenario_json: bytes | None = None) -> Recovered:
    """Write what is whole in a file into a new, finished one, by default FILE-recovered.mcap.

    `scenario_json` is the resolved scenario, for files that have lost theirs.

    Raises:
        RecordingError: nothing can be saved, the scenario is lost, or the new file exists or can't be made.
        ArgumentError: a scenario is given for a file that has its own.
    """
    layout = scan(file, lenient=True)
    if not (layout.chunks or layout.metadata or layout.attachments):
        raise RecordingError(f"{file} holds nothing that could be saved: no record of an MCAP file is whole")
    metadata, attachments = _front(layout, scenario_json)
    target = out or beside(file, "recovered")
    prefix = metadata[METADATA_NAME].get("prefix", "")
    lost = list(layout.damage)
    chunks = drawn = 0
    homeless: Counter[int] = Counter()
    topics: dict[int, str] = {}
    with Rewriter(target, metadata, attachments) as writer, open_file(file) as source:
        writer.flush()
        for place in layout.chunks:
            try:
                messages = read_chunk(source, place, layout.channels, times=False)
            except DAMAGE as error:
                lost.append(damage_of(file, place, error))
                continue
            chunks += 1
            for raw in messages:
                if raw.channel not in layout.channels:
                    homeless[raw.channel] += 1
                    continue
                topic = topics.get(raw.channel)
                if topic is None:
                    topic = topics[raw.channel] = topic_under(prefix, layout.channels[raw.channel].topic)
                writer.add(layout, raw, topic)
                drawn += not topic
        lost += [
            Damage(file, 0, 0, f"{count} messages are of channel {id}, of which nothing is known any more")
            for id, count in sorted(homeless.items())
        ]
        if layout.torn:
            offset = layout.size - layout.torn
            lost.append(
                Damage(file, offset, layout.torn, f"the last {layout.torn} bytes are no whole record")
            )
        streams = writer.tally.streams()
        found = Recovered(
            file=str(file),
            out=str(target),
            complete=layout.complete,
            messages=writer.messages - drawn,
            viewer_messages=drawn,
            chunks=chunks,
            lost_bytes=sum(damage.length for damage in lost),
            lost_chunks=len(layout.chunks) - chunks,
            lost_messages=homeless.total(),
            lost=tuple(damage.what for damage in lost),
            missing=sum(stream.missing for stream in streams),
            streams=tuple(stream for stream in streams if stream.missing),
        )
        writer.note_gaps()
        writer.note(RECOVERED_NAME, _noted(found))
    return found


def _front(
    layout: Layout, scenario_json: bytes | None
) -> tuple[Mapping[str, Mapping[str, str]], list[Attachment]]:
    """The metadata and attachments of the new file.

    Raises:
        RecordingError: the scenario is lost.
        ArgumentError: it is given and not lost.
    """
    own = layout.attachments.get(SCENARIO_NAME)
    if own is None and scenario_json is None:
        raise RecordingError(f"{layout.path} has lost its scenario; give it with --scenario FILE")
    if own is not None and scenario_json is not None:
        raise ArgumentError(f"{layout.path} has its scenario; leave out --scenario")
    attachments = list(layout.attachments.values())
    if own is None and scenario_json is not None:
        own = Attachment(0, 0, SCENARIO_NAME, "application/json", scenario_json)
        attachments.append(own)
    metadata = {name: values for name, values in layout.metadata.items() if name != GAPS_NAME}
    if own is not None and METADATA_NAME not in metadata:
        metadata[METADATA_NAME] = _told_by(layout, own.data)
    return metadata, attachments


def _told_by(layout: Layout, scenario_json: bytes) -> dict[str, str]:
    """What the scenario says of how a recording came about, where its own word is lost.

    Raises:
        RecordingError: it can't be read.
    """
    try:
        scenario = msgspec.json.decode(scenario_json, type=Scenario)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise RecordingError(f"{layout.path}: its scenario can't be read ({error})") from None
    return {"scenario": scenario.name, "seed": str(scenario.seed), "prefix": scenario.network.prefix}


def _noted(found: Recovered) -> Mapping[str, str]:
    counts = {name: str(getattr(found, name)) for name in ("lost_bytes", "lost_chunks", "lost_messages")}
    return {**counts, "lost": msgspec.json.encode(found.lost).decode()}
