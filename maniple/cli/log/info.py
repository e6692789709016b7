"""`maniple log info`."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from maniple.recording.info import ChannelInfo, Info, StreamInfo, describe
from maniple.recording.reader import read
from maniple.recording.tally import Stream

_GAPS_SHOWN = 3


def info(
    file: Annotated[Path, typer.Argument(help="Recording (MCAP) made by maniple, finished or not.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """List channels, counts, rates, what is missing by sequence number, duration, scenario and version.

    All parts of a recording (FILE, FILE-2, ...) count as one. Of a damaged file what is whole is counted.

    Exit status: 0 nothing is damaged, 1 something is, 2 bad input.
    """
    found = describe(read(file))
    if as_json:
        typer.echo(msgspec.json.encode({"file": str(file), **msgspec.structs.asdict(found)}))
    else:
        _print(file, found)
    raise typer.Exit(1 if found.damage else 0)


def _print(file: Path, found: Info) -> None:
    console = Console(width=None if Console().is_terminal else 120)
    console.print(_overview(file, found))
    console.print(_channel_table(found.channels))
    for channel in found.channels:
        for line in _remarks(channel):
            console.print(Text(line), soft_wrap=True)
    for line in found.absences:
        console.print(Text(f"left out on purpose: {line}"), soft_wrap=True)
    for line in found.other_scenarios:
        console.print(Text(line, style="yellow"), soft_wrap=True)
    for line in found.passed_over:
        console.print(Text(f"passed over: {line}"), soft_wrap=True)
    if found.lacking:
        console.print(Text(f"lacking: {found.lacking}", style="yellow"), soft_wrap=True)
    for line in found.damage:
        console.print(Text(f"damaged: {line}", style="red"), soft_wrap=True)
    if found.damage:
        console.print(
            Text(f"`maniple log recover {file}` makes a recording of what is whole."), soft_wrap=True
        )


def _overview(file: Path, found: Info) -> Table:
    table = Table.grid(padding=(0, 2))
    rows = {
        "file": str(file) if len(found.parts) == 1 else " ".join(found.parts),
        "scenario": found.scenario,
        "version": found.version,
        "mode": found.mode,
        "seed": found.seed,
        "state": _state(found),
        "duration": f"{found.duration_s:.3f} s",
        "messages": f"{found.messages} ({found.bytes} bytes), {found.missing} missing by sequence number"
        + (f", {found.left_out} left out on purpose" if found.left_out else ""),
        "for viewers": f"{found.viewer_channels} channels" if found.viewer_channels else "nothing",
    }
    for name, value in rows.items():
        table.add_row(Text(name, style="bold"), Text(value))
    return table


def _state(found: Info) -> str:
    if found.damage:
        return "damaged, see below"
    if found.complete:
        return "finished"
    torn = f"; the last {found.torn_bytes} bytes are no whole record" if found.torn_bytes else ""
    return f"not finished: read up to where it stops being whole{torn}"


def _channel_table(channels: Iterable[ChannelInfo]) -> Table:
    table = Table("topic", "type")
    for heading in ("messages", "rate / Hz", "bytes", "missing"):
        table.add_column(heading, justify="right", no_wrap=True)
    for channel in channels:
        table.add_row(
            Text(channel.topic),
            channel.type or "unknown",
            str(channel.messages),
            f"{channel.rate_hz:.2f}",
            str(channel.bytes),
            str(channel.missing),
        )
    return table


def _remarks(channel: ChannelInfo) -> Iterable[str]:
    """One line for each stream with something to say about, and for messages that say too little."""
    for stream in channel.streams:
        if stream.missing or stream.repeated:
            yield f"{channel.topic}: {_stream_text(stream)}"
    if channel.headless:
        yield f"{channel.topic}: {channel.headless} messages without a valid header"
    if channel.unreadable:
        yield f"{channel.topic}: {channel.unreadable} messages that this version can't read"


def _stream_text(stream: StreamInfo) -> str:
    more = [f"{stream.left_out} of {stream.sent} left out on purpose"] if stream.left_out else []
    return ", ".join([gaps_text(stream), *more])


def gaps_text(stream: Stream) -> str:
    """What is missing of a stream, in a line."""
    parts = []
    if not stream.recorded:
        parts.append("none recorded")
    if stream.missed_first:
        parts.append(f"missed the first {stream.missed_first}")
    last = stream.sent - stream.missed_last
    inner = [gap for gap in stream.gaps if 0 < gap.first < last]
    if inner:
        shown = [f"{g.first}" if g.first == g.last else f"{g.first}-{g.last}" for g in inner[:_GAPS_SHOWN]]
        more = f" and {len(inner) - _GAPS_SHOWN} more gaps" if len(inner) > _GAPS_SHOWN else ""
        parts.append(f"seq {', '.join(shown)}{more}")
    if stream.missed_last and stream.recorded:
        parts.append(f"missed the last {stream.missed_last}")
    if stream.missing:
        parts.append(f"{stream.missing} of {stream.sent} missing")
    if stream.repeated:
        parts.append(f"{stream.repeated} repeated")
    return f"{stream.source or '?'} (incarnation {stream.incarnation}): {', '.join(parts)}"
