"""A recording as Parquet files."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from maniple.core.errors import MissingExtraError
from maniple.recording.columns import Cells, Form
from maniple.recording.export_tables import Exported, Sink, export_tables
from maniple.recording.reader import Recording
from maniple.recording.selection import Selection
from maniple.recording.table import EXTRA


def export_parquet(
    recording: Recording, out: Path, selection: Selection | None = None, force: bool = False
) -> Exported:
    """Write a folder of Parquet files, as `export_tables` says. Units are in the metadata of the columns, the
    scenario in that of each file.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise MissingExtraError("export to Parquet", EXTRA) from None
    return export_tables(recording, out, selection or Selection(), force, "parquet", _ParquetSink)


class _ParquetSink(Sink):
    """A Parquet file; each batch becomes a row group."""

    def __init__(self, path: Path, form: Form, notes: Mapping[str, str]) -> None:
        import pyarrow.parquet as pq

        from maniple.recording.arrow import schema_of

        self._schema = schema_of(form.columns, {f"maniple.{key}": text for key, text in notes.items()})
        self._file = path.open("xb")
        self._writer = pq.ParquetWriter(self._file, self._schema, compression="zstd")

    def write(self, cells: Sequence[Cells]) -> None:
        """Append rows, given by column."""
        from maniple.recording.arrow import batch_of

        self._writer.write_batch(batch_of(self._schema, cells))

    def close(self) -> None:
        """Finish the file."""
        with self._file:
            self._writer.close()
