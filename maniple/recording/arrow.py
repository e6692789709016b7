"""Cells as Arrow; imports pyarrow, of the extra `export`."""

from collections.abc import Iterable, Mapping

import numpy as np
import pyarrow as pa

from maniple.recording.columns import Cells, Column, Kind

_TYPES: Mapping[Kind, pa.DataType] = {
    "int": pa.int64(),
    "float": pa.float64(),
    "float32": pa.float32(),
    "bool": pa.bool_(),
    "text": pa.string(),
    "bytes": pa.binary(),
    "json": pa.string(),
    "ints": pa.int64(),
    "floats": pa.float64(),
    "texts": pa.string(),
    "array": pa.float32(),
}


def schema_of(columns: Iterable[Column], metadata: Mapping[str, str] | None = None) -> pa.Schema:
    """The schema of a table, with what each column holds as its metadata: unit, and what numbers."""
    return pa.schema([_field(column) for column in columns], metadata=dict(metadata or {}))


def batch_of(schema: pa.Schema, cells: Iterable[Cells]) -> pa.RecordBatch:
    """One batch of rows."""
    arrays = [_array(one, field.type) for one, field in zip(cells, schema, strict=True)]
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


def _field(column: Column) -> pa.Field:
    kind = _TYPES[column.kind]
    if len(column.parts) > 1:
        kind = pa.list_(kind, len(column.parts))
    if column.is_list:
        kind = pa.list_(kind)
    notes = {"unit": column.unit, "columns": ", ".join(column.parts), "json": "yes" * (column.kind == "json")}
    return pa.field(column.name, kind, column.optional, {key: text for key, text in notes.items() if text})


def _array(cells: Cells, kind: pa.DataType) -> pa.Array:
    if cells.lengths is None:
        return pa.array(cells.values, kind, mask=None if cells.known is None else ~cells.known)
    offsets = np.concatenate(([0], np.cumsum(cells.lengths))).astype(np.int32)
    values = pa.array(cells.values.reshape(-1), kind.value_type if cells.values.ndim == 1 else pa.float32())
    if cells.values.ndim > 1:
        values = pa.FixedSizeListArray.from_arrays(values, cells.values.shape[1])
    return pa.ListArray.from_arrays(pa.array(offsets), values, type=kind)
