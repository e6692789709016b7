"""`maniple log merge`."""

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from maniple.core.errors import ArgumentError
from maniple.core.time import to_seconds
from maniple.recording.merge import Merged, Source
from maniple.recording.merge import merge as write_merged
from maniple.recording.reader import read


def merge(
    files: Annotated[list[Path], typer.Argument(help="Recordings (MCAP) of one run by several recorders.")],
    out: Annotated[
        Path | None, typer.Option(help="The new file, never one that exists; by default FILE-merged.mcap.")
    ] = None,
    reference: Annotated[
        Path | None, typer.Option(help="Whose clock is kept, one of FILES; by default the first.")
    ] = None,
    take_reference: Annotated[
        bool,
        typer.Option(
            "--take-reference",
            help="Where a message is not the same in two recordings, take that of the reference.",
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Join what several recorders recorded of one run: each message once, on one clock.

    What one recorder's clock is ahead of another's is estimated from the messages that both have. A message
    that is not the same in two recordings was changed in one of them: then nothing is written, unless
    --take-reference.

    Exit status: 0 written, 1 messages differ and nothing is written, 2 bad input.
    """
    if reference is not None and reference not in files:
        raise ArgumentError(f"--reference {reference}: must be one of {', '.join(map(str, files))}")
    index = 0 if reference is None else files.index(reference)
    found = write_merged([read(file) for file in files], out, index, take_reference)
    if as_json:
        typer.echo(msgspec.json.encode(found))
    else:
        _print(found)
    raise typer.Exit(0 if found.out else 1)


def _print(found: Merged) -> None:
    for source in found.sources:
        typer.echo(f"{' '.join(source.files)}: {source.messages} messages, {_role(source, found)}")
    for one in found.differences:
        life = f"{one.source} (incarnation {one.incarnation})"
        typer.echo(f"differs in {one.file}: {one.topic}, {life}, seq {one.seq}")
    if found.differing > len(found.differences):
        typer.echo(f"{found.differing} messages differ in all")
    if found.out:
        typer.echo(f"{found.messages} messages, {found.missing} missing by sequence number")
        typer.echo(f"recording: {found.out}")
    else:
        typer.echo("nothing is written: a message that differs was changed in one of them (--take-reference)")


def _role(source: Source, found: Merged) -> str:
    if source is found.sources[0]:
        return "its clock is kept"
    new = f"{source.only_here} of them only there"
    if (offset := source.offset) is None:
        return f"{new}; by the same clock, as its recorder says"
    return (
        f"{new}; its clock is {to_seconds(offset.ahead_ns):+.6f} s ahead, drift {offset.drift_ppm:+.1f} ppm, "
        f"spread {to_seconds(offset.spread_ns) * 1e3:.3f} ms over {offset.common} common messages"
    )
