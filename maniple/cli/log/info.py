"""`maniple log info`."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from maniple.recording.info import ChannelInfo, Info, Stream, describe
from maniple.recording.reader import read

_GAPS_SHOWN = 3


def info(
    file: Annotated[Path, typer.Argument(help="Recording (MCAP) made by maniple, finished or not.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """List channels, counts, rates, gaps by sequence number, duration, scenario and version."""
    found = describe(read(file))
    if as_json:
        typer.echo(msgspec.json.encode({"file": str(file), **msgspec.structs.asdict(found)}))
        return
    console = Console(width=None if Console().is_terminal else 120)
    console.print(_overview(file, found))
    console.print(_channel_table(found.channels))
    for channel in found.channels:
        for line in _remarks(channel):
            console.print(Text(line), soft_wrap=True)


def _overview(file: Path, found: Info) -> Table:
    table = Table.grid(padding=(0, 2))
    rows = {
        "file": str(file),
        "scenario": found.scenario,
        "version": found.version,
        "mode": found.mode,
        "seed": found.seed,
        "state": "finished" if found.complete else "not finished: read up to where it stops being whole",
        "duration": f"{found.duration_s:.3f} s",
        "messages": f"{found.messages} ({found.bytes} bytes), {found.missing} missing by sequence number",
    }
    for name, value in rows.items():
        table.add_row(Text(name, style="bold"), Text(value))
    return table


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
    """One line for each stream with something to say about, and for messages without a header."""
    for stream in channel.streams:
        if stream.missing or stream.repeated:
            yield f"{channel.topic}: {_stream_text(stream)}"
    if channel.headless:
        yield f"{channel.topic}: {channel.headless} messages without a valid header"


def _stream_text(stream: Stream) -> str:
    parts = []
    if stream.missed_first:
        parts.append(f"missed the first {stream.missed_first}")
    inner = [gap for gap in stream.gaps if gap.first > 0]
    if inner:
        shown = [f"{g.first}" if g.first == g.last else f"{g.first}-{g.last}" for g in inner[:_GAPS_SHOWN]]
        more = f" and {len(inner) - _GAPS_SHOWN} more gaps" if len(inner) > _GAPS_SHOWN else ""
        parts.append(f"seq {', '.join(shown)}{more}")
    if stream.missing:
        parts.append(f"{stream.missing} of {stream.expected} missing")
    if stream.repeated:
        parts.append(f"{stream.repeated} repeated")
    return f"{stream.source or '?'} (incarnation {stream.incarnation}): {', '.join(parts)}"
