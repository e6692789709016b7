"""`maniple log export`."""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import typer

from maniple.cli.interrupt import on_interrupt
from maniple.cli.log.options import From, Topics, Until, Without, selection_of
from maniple.recording.export_csv import export_csv
from maniple.recording.export_parquet import export_parquet
from maniple.recording.export_tables import Exported, told
from maniple.recording.reader import read

_WRITERS = {"parquet": export_parquet, "csv": export_csv}


def export(
    file: Annotated[Path, typer.Argument(help="Recording (MCAP) made by maniple, finished or not.")],
    to: Annotated[
        Literal["parquet", "csv"],
        typer.Option("--to", help="parquet, csv: a folder of tables, one for each kind of topic."),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Where to write. [default: FILE-parquet, FILE-csv beside FILE]")
    ] = None,
    topic: Topics = None,
    without: Without = None,
    start: From = None,
    until: Until = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier export that is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Write a recording in a format that other tools read.

    parquet needs pip install 'maniple[export]'.

    Exit status: 0 written, 2 bad input, 130 interrupted (then nothing is left behind).
    """
    recording = read(file)
    selection = selection_of(recording, start, until, topic, without)
    with on_interrupt(_stop):
        exported = _WRITERS[to](recording, out or file.with_name(f"{file.stem}-{to}"), selection, force)
    if as_json:
        typer.echo(msgspec.json.encode(exported))
        return
    _tell(exported)


def _stop() -> None:
    raise KeyboardInterrupt


def _tell(exported: Exported) -> None:
    for note in told(exported):
        typer.echo(f"note: {note}")
    rows = sum(table.rows for table in exported.tables)
    typer.echo(
        f"{exported.messages} messages as {rows} rows in {len(exported.tables)} tables: {exported.out}"
    )
