"""`maniple log cut`."""

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from maniple.cli.log.options import From, Topics, Until, Without, selection_of
from maniple.core.errors import ArgumentError
from maniple.recording.cut import cut as write_cut
from maniple.recording.reader import read
from maniple.recording.selection import EVERYTHING


def cut(
    file: Annotated[Path, typer.Argument(help="Recording (MCAP) made by maniple, finished or not.")],
    start: From = None,
    until: Until = None,
    topic: Topics = None,
    without: Without = None,
    out: Annotated[
        Path | None, typer.Option(help="The new file, never one that exists; by default FILE-cut.mcap.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Make a recording of a part of one, by time and topics.

    The scenario goes with it, and the last value of every latched topic from before. The parts of a recording
    become one file, also with no options at all. Channels for viewers are taken unless topics are chosen;
    their names are topics, too: --topic "viz/**".

    Exit status: 0 written, 2 bad input.
    """
    recording = read(file)
    viewers = [key.strip("/") for key in recording.viewer_keys]
    selection = selection_of(recording, start, until, topic, without, viewers)
    if selection == EVERYTHING and len(recording.paths) == 1:
        raise ArgumentError("say what to take, with --from, --until, --topic or --without")
    found = write_cut(recording, selection, out)
    if as_json:
        typer.echo(msgspec.json.encode(found))
        return
    drawn = f" and {found.viewer_messages} for viewers" if found.viewer_messages else ""
    typer.echo(f"{found.messages} messages{drawn}")
    if found.latched:
        typer.echo(f"attached from before, as it still holds: {', '.join(found.latched)}")
    typer.echo(f"recording: {found.out}")
