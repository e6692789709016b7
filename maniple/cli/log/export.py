"""`maniple log export`."""

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import msgspec
import typer

from maniple.cli.interrupt import on_interrupt
from maniple.cli.log.options import From, Topics, Until, Without, selection_of
from maniple.core.errors import MissingExtraError
from maniple.recording.export_csv import export_csv
from maniple.recording.export_foxglove import export_foxglove
from maniple.recording.export_parquet import export_parquet
from maniple.recording.export_tables import Exported, told
from maniple.recording.reader import Recording, read
from maniple.recording.selection import Selection
from maniple.recording.viz.export import ExportedFile

Format: TypeAlias = Literal["parquet", "csv", "foxglove", "rerun", "rosbag2"]

_ENDINGS: dict[Format, str] = {
    "parquet": "-parquet",
    "csv": "-csv",
    "foxglove": "-foxglove.mcap",
    "rerun": ".rrd",
    "rosbag2": "-rosbag2",
}


def export(
    file: Annotated[Path, typer.Argument(help="Recording (MCAP) made by maniple, finished or not.")],
    to: Annotated[
        Format,
        typer.Option(
            "--to",
            help="parquet, csv: a folder of tables, one for each kind of topic. foxglove: an MCAP file with "
            "what Foxglove and Lichtblick draw. rerun: an .rrd file for the Rerun viewer. rosbag2: a bag of "
            "ROS 2 with poses, scans, frames and markers.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Where to write; else FILE-parquet, FILE-csv, FILE-foxglove.mcap, FILE.rrd or FILE-rosbag2 "
            "beside FILE."
        ),
    ] = None,
    topic: Topics = None,
    without: Without = None,
    start: From = None,
    until: Until = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier export that is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Write a recording in a format that other tools read.

    parquet needs the extra "export", rerun the extra "rerun", rosbag2 the extra "ros2".

    Exit status: 0 written, 2 bad input, 130 interrupted (then nothing is left behind).
    """
    recording = read(file)
    selection = selection_of(recording, start, until, topic, without)
    with on_interrupt(_stop):
        exported = _write(recording, to, out or file.with_name(file.stem + _ENDINGS[to]), selection, force)
    if as_json:
        typer.echo(msgspec.json.encode(exported))
    else:
        _tell(exported)


def _write(
    recording: Recording, to: Format, out: Path, selection: Selection, force: bool
) -> Exported | ExportedFile:
    match to:
        case "parquet":
            return export_parquet(recording, out, selection, force)
        case "csv":
            return export_csv(recording, out, selection, force)
        case "foxglove":
            return export_foxglove(recording, out, selection, force)
        case "rerun":
            try:
                import rerun  # noqa: F401
            except ImportError:
                raise MissingExtraError("export to Rerun", "rerun") from None
            from maniple.recording.export_rerun import export_rerun

            return export_rerun(recording, out, selection, force)
        case "rosbag2":
            try:
                import rosbags.rosbag2  # noqa: F401
            except ImportError:
                raise MissingExtraError("export to rosbag2", "ros2") from None
            from maniple.recording.export_rosbag2 import export_rosbag2

            return export_rosbag2(recording, out, selection, force)


def _stop() -> None:
    raise KeyboardInterrupt


def _tell(exported: Exported | ExportedFile) -> None:
    if isinstance(exported, Exported):
        notes = told(exported.complete, exported.unreadable, exported.unknown)
        rows = sum(table.rows for table in exported.tables)
        made = f"{rows} rows in {len(exported.tables)} tables"
    else:
        notes = told(exported.complete, exported.unreadable, {})
        made = f"{exported.drawn} {'of ROS 2' if exported.format == 'rosbag2' else 'for viewers'}"
    for note in notes:
        typer.echo(f"note: {note}")
    typer.echo(f"{exported.messages} messages as {made}: {exported.out}")
