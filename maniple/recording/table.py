"""Messages of a recording as columns: NumPy arrays, or a table of pandas or Arrow."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from maniple.core import topics
from maniple.core.errors import ArgumentError, MessageError, MissingExtraError
from maniple.core.messages import Message
from maniple.core.time import Time
from maniple.recording import columns as forms
from maniple.recording.columns import DTYPES, Cells, Column, Form, Row
from maniple.recording.reader import Recorded, Recording
from maniple.recording.selection import Selection, matches

if TYPE_CHECKING:
    import pandas
    import pyarrow

EXTRA = "export"
BATCH_ROWS = 16384
BATCH_BYTES = 1 << 20
"""Of messages as they were on the wire: what is decoded and in memory at once."""


class Table(Mapping[str, NDArray[Any]]):
    """Columns by name, as NumPy arrays with a row for each message, or for each of its elements.

    Numbers are int64 and float64 of shape (k,), text is object. What a message may lack is a masked array.
    Lists of numbers are (k, most), float arrays of the wire float32 (k, most) or (k, most, numbers of a row):
    beyond the end of a row they hold NaN, whole numbers are masked. Lists of text are tuples.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        columns: tuple[Column, ...],
        cells: tuple[Cells, ...],
        unreadable: Mapping[str, int],
    ) -> None:
        self.topics = names
        """The topics it was made of, sorted."""
        self.columns = {column.name: column for column in columns}
        self.cells = dict(zip(self.columns, cells, strict=True))
        self.unreadable = dict(unreadable)
        """How many messages are left out because they are no valid ones of their topic, by topic."""

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self.columns:
            raise KeyError(f"no column {name!r}; there are {', '.join(self.columns)}")
        return _numpy(self.columns[name], self.cells[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def __repr__(self) -> str:
        left_out = sum(self.unreadable.values())
        told = f", without {left_out} invalid messages" if left_out else ""
        return (
            f"<Table of {', '.join(self.topics) or 'no topics'}: {self.rows} rows of {', '.join(self)}{told}>"
        )

    @property
    def rows(self) -> int:
        """How many there are."""
        return len(self.cells["log_time_ns"].values)

    @property
    def units(self) -> dict[str, str]:
        """The unit of each column that has one."""
        return {name: column.unit for name, column in self.columns.items() if column.unit}

    def to_pandas(self) -> "pandas.DataFrame":
        """As a pandas frame: lists and arrays are NumPy arrays in the cells, units in `attrs["units"]`.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise MissingExtraError("a table of pandas", EXTRA) from None
        frame = pandas.DataFrame({name: _series(self.columns[name], one) for name, one in self.cells.items()})
        frame.attrs["units"] = self.units
        return frame

    def to_arrow(self) -> "pyarrow.Table":
        """As an Arrow table: lists are lists, units in the metadata of the columns.

        Raises:
            MissingExtraError: pyarrow is not installed.
        """
        try:
            import pyarrow
        except ImportError:
            raise MissingExtraError("an Arrow table", EXTRA) from None
        from maniple.recording.arrow import batch_of, schema_of

        schema = schema_of(self.columns.values())
        return pyarrow.Table.from_batches([batch_of(schema, self.cells.values())])


class Gatherer:
    """Turns messages into cells, a batch at a time: only one batch of messages is in memory."""

    def __init__(self, form: Form) -> None:
        self.form = form
        self.rows = 0
        """How many it has given out."""
        self.unreadable: Counter[str] = Counter()
        """Rows left out because a number has no room in 64 bits, by topic."""
        self._rows: list[Row] = []
        self._bytes = 0

    @property
    def full(self) -> bool:
        """Whether it is time to `take`."""
        return len(self._rows) >= BATCH_ROWS or self._bytes >= BATCH_BYTES

    def add(self, record: Recorded, message: Message) -> None:
        """Take in a message."""
        self._rows += forms.rows_of(self.form, record.topic, record.log_time_ns, message)
        self._bytes += len(record.data)

    def take(self) -> tuple[Cells, ...]:
        """The cells of the rows since the last, by column."""
        rows, self._rows, self._bytes = self._rows, [], 0
        try:
            found = tuple(forms.cells(column, rows) for column in self.form.columns)
        except OverflowError:
            fitting = [row for row in rows if forms.fits(self.form.columns, row)]
            self.unreadable.update(row.topic for row in rows)
            self.unreadable.subtract(row.topic for row in fitting)
            self.unreadable = +self.unreadable
            rows = fitting
            found = tuple(forms.cells(column, rows) for column in self.form.columns)
        self.rows += len(rows)
        return found


def table(
    recording: Recording, wanted: str | type[Message], each: str = "", selection: Selection | None = None
) -> Table:
    """The messages of the `wanted` topics ("robot/*/odometry"), or of one type, as columns.

    A row is a message, or with `each` one of what messages of this type have several of ("robots" of
    "sim/truth", "triangles" of "formation/state"). `t_s` counts from the first message of the recording, by
    arrival there; `stamp_ns` is by the sender's clock. A `selection` narrows time and topics.

    Raises:
        ArgumentError: nothing like `wanted` is there, it means topics of several types, or they have no such
            elements.
        RecordingError: the recording is damaged.
    """
    kind, identity, names = _wanted(recording, wanted)
    form = form_of(kind, each, identity, recording.start_ns)
    gatherer = Gatherer(form)
    batches: list[tuple[Cells, ...]] = []
    unreadable: Counter[str] = Counter()
    chosen = selection or Selection()
    taken = frozenset(filter(chosen.takes, names))
    for record in recording.messages(taken.__contains__, chosen.start_ns, chosen.end_ns):
        try:
            gatherer.add(record, record.decode())
        except MessageError:
            unreadable[record.topic] += 1
        if gatherer.full:
            batches.append(gatherer.take())
    batches.append(gatherer.take())
    cells = tuple(_joined(parts) for parts in zip(*batches, strict=True))
    return Table(tuple(sorted(taken)), form.columns, cells, unreadable + gatherer.unreadable)


def form_of(kind: type[Message], each: str, identity: str, start_ns: Time) -> Form:
    """`columns.form`, for an `each` that was asked for.

    Raises:
        ArgumentError: messages of this type have no such elements.
    """
    there = forms.parts_of(kind)
    if each and each not in there:
        has = f"has {', '.join(there)}" if there else "has none of those"
        raise ArgumentError(f"each = {each!r}: {kind.__name__} {has}")
    return forms.form(kind, each, identity, start_ns)


def identity_of(pattern: str) -> str:
    """What the second part of a topic with this pattern is: "robot", "node", or nothing."""
    if "{id}" not in pattern:
        return ""
    return "robot" if pattern.startswith(("robot/", "hw/")) else "node"


def is_known(name: str) -> bool:
    """Whether a topic is in the table of topics."""
    try:
        topics.topic(name)
    except MessageError:
        return False
    return True


def known(recording: Recording) -> dict[str, topics.Topic]:
    """The topics of a recording that are in the table of topics, each with its row."""
    return {name: topics.topic(name) for name in recording.topics if is_known(name)}


def _wanted(recording: Recording, wanted: str | type[Message]) -> tuple[type[Message], str, frozenset[str]]:
    """The type and identity of the topics that are meant, and their names."""
    there = known(recording)
    if isinstance(wanted, str):
        names = frozenset(name for name in there if matches(wanted, name))
        rows = [there[name] for name in sorted(names)]
        if not rows and is_known(wanted):
            rows = [topics.topic(wanted)]
        if not rows:
            held = ", ".join(there) or "none"
            raise ArgumentError(f"no topic of {recording.path} matches {wanted!r}; there are {held}")
    else:
        rows = [row for row in topics.TOPICS if row.type is wanted]
        names = frozenset(name for name, row in there.items() if row.type is wanted)
        if not rows:
            raise ArgumentError(f"{wanted.__name__} is not the type of any topic")
    kinds = {row.type: row.pattern for row in rows}
    if len(kinds) > 1:
        several = ", ".join(f"{pattern} ({kind.__name__})" for kind, pattern in kinds.items())
        raise ArgumentError(f"{wanted!r} matches topics of several types, and a table holds one: {several}")
    return rows[0].type, identity_of(rows[0].pattern), names


def _joined(parts: tuple[Cells, ...]) -> Cells:
    """The cells of all batches."""
    values = np.concatenate([part.values for part in parts])
    lengths = [part.lengths for part in parts if part.lengths is not None]
    if any(part.known is not None for part in parts):
        there = [np.ones(len(p.values), np.bool_) if p.known is None else p.known for p in parts]
        return Cells(values, None, np.concatenate(there))
    return Cells(values, np.concatenate(lengths) if lengths else None)


def _numpy(column: Column, cells: Cells) -> NDArray[Any]:
    """A column as an array with one row for each row of the table."""
    if cells.lengths is None:
        if DTYPES[column.kind] is object or not column.optional:
            return cells.values
        return np.ma.MaskedArray(cells.values, mask=False if cells.known is None else ~cells.known)
    if column.kind == "texts":
        texts = np.empty(len(cells.lengths), dtype=object)
        texts[:] = [tuple(one) for one in _split(cells)]
        return texts
    most = int(cells.lengths.max(initial=0))
    there = np.arange(most) < cells.lengths[:, None]
    fill = 0 if column.kind == "ints" else np.nan
    padded = np.full((*there.shape, *cells.values.shape[1:]), fill, dtype=cells.values.dtype)
    padded[there] = cells.values
    return np.ma.MaskedArray(padded, mask=~there) if column.kind == "ints" else padded


def _series(column: Column, cells: Cells) -> Any:
    """A column for pandas."""
    import pandas

    if cells.lengths is not None:
        lists = np.empty(len(cells.lengths), dtype=object)
        lists[:] = _split(cells)
        return lists
    unknown = np.zeros(len(cells.values), np.bool_) if cells.known is None else ~cells.known
    if column.optional and column.kind == "int":
        return pandas.arrays.IntegerArray(cells.values, unknown)
    if column.optional and column.kind == "bool":
        return pandas.arrays.BooleanArray(cells.values, unknown)
    return cells.values


def _split(cells: Cells) -> list[NDArray[Any]]:
    """The list of each row."""
    assert cells.lengths is not None
    return np.split(cells.values, np.cumsum(cells.lengths)[:-1]) if len(cells.lengths) else []
