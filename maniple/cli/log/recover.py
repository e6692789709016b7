"""`maniple log recover`."""

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from maniple.cli.log.info import gaps_text
from maniple.recording.recover import recover as write_recovered

_SHOWN = 20


def recover(
    file: Annotated[Path, typer.Argument(help="Recording (MCAP) that is unfinished, cut off or damaged.")],
    out: Annotated[
        Path | None, typer.Option(help="The new file, never one that exists; by default FILE-recovered.mcap.")
    ] = None,
    scenario: Annotated[
        Path | None, typer.Option(help="Scenario of the run (TOML), for a file that has lost its own.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Save what is whole in a file into a new, finished one, and say what is lost.

    Damaged chunks are skipped, and after bytes that can't be read the next whole record is looked for. FILE
    stays as it is. The parts of a recording are recovered one by one.

    Exit status: 0 saved, whatever was lost; 2 nothing can be saved, or bad input.
    """
    given = None
    if scenario is not None:
        from maniple.cli.loading import load
        from maniple.core.scenario.parse import to_json

        given = to_json(load(scenario))
    found = write_recovered(file, out, given)
    if as_json:
        typer.echo(msgspec.json.encode(found))
        return
    drawn = f" and {found.viewer_messages} for viewers" if found.viewer_messages else ""
    typer.echo(f"saved: {found.messages} messages{drawn} in {found.chunks} chunks")
    for line in found.lost[:_SHOWN]:
        typer.echo(f"lost: {line}")
    if len(found.lost) > _SHOWN:
        typer.echo(f"lost: {len(found.lost) - _SHOWN} more stretches")
    if found.lost_bytes:
        typer.echo(f"lost: {found.lost_bytes} bytes in all")
    for stream in found.streams[:_SHOWN]:
        typer.echo(f"missing: {stream.topic}: {gaps_text(stream)}")
    if len(found.streams) > _SHOWN:
        rest = sum(stream.missing for stream in found.streams[_SHOWN:])
        typer.echo(f"missing: {rest} messages of {len(found.streams) - _SHOWN} more senders and topics")
    if not (found.lost or found.streams):
        typer.echo("nothing is lost")
    typer.echo(f"recording: {found.out}")
