"""`maniple report`."""

from pathlib import Path
from typing import Annotated

import msgspec
import typer


def report(
    file: Annotated[Path, typer.Argument(help="Recording (MCAP) made by maniple, finished or not.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder to write to; by default FILE-report beside FILE.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the files of an earlier report in that folder.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Write figures (PNG and SVG) and one self-contained HTML page from a recording alone.

    Exit status: 0 written, 2 bad input.
    """
    from maniple.report.writing import write

    written = write(file, out, force)
    if as_json:
        typer.echo(msgspec.json.encode(written))
        return
    typer.echo(written.outcome)
    for note in written.notes:
        typer.echo(f"note: {note}")
    typer.echo(f"report: {written.page}")
