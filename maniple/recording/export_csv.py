"""A recording as CSV files (RFC 4180, UTF-8): a header, then a line a row.

Numbers are the shortest that read back as the same; lists and arrays are JSON, bytes base64. What has no
value is an empty field, as an empty text is.
"""

import csv
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from maniple.recording.columns import Cells, Column, Form
from maniple.recording.export_tables import Exported, Sink, export_tables
from maniple.recording.reader import Recording
from maniple.recording.selection import Selection


def export_csv(
    recording: Recording, out: Path, selection: Selection | None = None, force: bool = False
) -> Exported:
    """Write a folder of CSV files, as `export_tables` says; units are in its `tables.json`."""
    return export_tables(recording, out, selection or Selection(), force, "csv", _CsvSink)


class _CsvSink(Sink):
    """A CSV file."""

    def __init__(self, path: Path, form: Form, _notes: Mapping[str, str]) -> None:
        self._columns = form.columns
        self._file = path.open("x", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow(column.name for column in form.columns)

    def write(self, cells: Sequence[Cells]) -> None:
        """Append rows, given by column."""
        texts = [_texts(column, one) for column, one in zip(self._columns, cells, strict=True)]
        self._writer.writerows(zip(*texts, strict=True))

    def close(self) -> None:
        """Finish the file."""
        self._file.close()


def _texts(column: Column, cells: Cells) -> list[str]:
    """The fields of a column."""
    values = _numbers(cells.values)
    if cells.lengths is not None:
        ends = np.concatenate(([0], np.cumsum(cells.lengths))).tolist()
        return [msgspec.json.encode(values[a:b]).decode() for a, b in pairwise(ends)]
    text = _TEXT.get(column.kind, str)
    known = [True] * len(values) if cells.known is None else cells.known.tolist()
    return [text(value) if there else "" for value, there in zip(values, known, strict=True)]


def _numbers(values: NDArray[Any]) -> list[Any]:
    """The values, float32 as the shortest numbers that are the same in float32."""
    if values.dtype != np.float32:
        return list(values.tolist())
    return list(values.astype(str).astype(np.float64).tolist())


_TEXT: Mapping[str, Callable[[Any], str]] = {
    "float": repr,
    "float32": repr,
    "bool": lambda value: "true" if value else "false",
    "bytes": lambda value: b64encode(value).decode(),
}
