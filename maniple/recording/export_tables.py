"""A recording as a folder of tables: a file for each topic, and one for what its messages have several of."""

import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from secrets import token_hex
from typing import Protocol

import msgspec

from maniple.core.errors import ArgumentError, ManipleError, MessageError
from maniple.core.messages import Message
from maniple.core.time import Time
from maniple.core.topics import TOPICS, Topic
from maniple.recording.columns import Cells, Form, form, parts_of
from maniple.recording.reader import Recorded, Recording
from maniple.recording.selection import Selection
from maniple.recording.table import Gatherer, identity_of, known

INDEX = "tables.json"
"""What is in the folder, for machines; it marks the folder as one of ours."""

SCENARIO = "scenario.json"
README = "README.md"


class Sink(Protocol):
    """A table that is being written."""

    def write(self, cells: Sequence[Cells]) -> None:
        """Append rows, given by column."""

    def close(self) -> None:
        """Finish the file."""


Opener = Callable[[Path, Form, Mapping[str, str]], Sink]
"""Makes a sink for a file; the last argument says what the table is."""


class ColumnInfo(msgspec.Struct, frozen=True):
    """One column of a table."""

    name: str
    kind: str
    """ "int", "float", "float32", "bool", "text", "bytes", "json" (text), or a list: "ints",
    "floats", "texts", "array"."""
    unit: str
    """Of its numbers; empty where they have none."""
    parts: tuple[str, ...] = ()
    """Of an array: what the numbers of each of its rows are."""


class TableInfo(msgspec.Struct, frozen=True):
    """One table of a folder."""

    file: str
    topics: str
    """ "robot/*/odometry"."""
    type: str
    """Of its messages."""
    each: str
    """What of a message a row is for; empty: the message."""
    rows: int
    columns: tuple[ColumnInfo, ...]


class Exported(msgspec.Struct, frozen=True, kw_only=True):
    """What was written."""

    recordings: tuple[str, ...]
    out: str
    format: str
    scenario: str
    messages: int
    """How many were taken."""
    unreadable: dict[str, int]
    """Messages that are left out because they are no valid ones of their topic, by topic."""
    unknown: dict[str, int]
    """Messages of topics that this version does not know, left out too."""
    complete: bool
    """Whether the recording was finished."""
    tables: tuple[TableInfo, ...]


class _Table:
    """A table that is being written."""

    def __init__(self, row: Topic, each: str, start_ns: Time) -> None:
        self.row, self.each = row, each
        self.topics = row.pattern.replace("{id}", "*")
        self.name = ".".join(filter(None, (row.pattern.replace("/{id}", "").replace("/", "-"), each)))
        self.gatherer = Gatherer(form(row.type, each, identity_of(row.pattern), start_ns))
        self.sink: Sink

    def add(self, record: Recorded, message: Message) -> None:
        """Take in a message."""
        self.gatherer.add(record, message)
        if self.gatherer.full:
            self.flush()

    def flush(self) -> None:
        """Write what has been taken in."""
        self.sink.write(self.gatherer.take())

    def info(self, format: str) -> TableInfo:
        columns = tuple(ColumnInfo(c.name, c.kind, c.unit, c.parts) for c in self.gatherer.form.columns)
        return TableInfo(
            f"{self.name}.{format}",
            self.topics,
            self.row.type.__name__,
            self.each,
            self.gatherer.rows,
            columns,
        )


def export_tables(
    recording: Recording, out: Path, selection: Selection, force: bool, format: str, open_sink: Opener
) -> Exported:
    """Write the tables of a recording into the folder `out`. It is there whole or not at all.

    Memory does not grow with the recording: rows are written in batches as they come.

    Raises:
        ArgumentError: `out` holds something, and is no earlier export or not to be replaced.
        RecordingError: the recording is damaged.
        ManipleError: the folder can't be written.
    """
    rows = {name: row for name, row in known(recording).items() if selection.takes(name)}
    tables = {
        row.pattern: [_Table(row, each, recording.start_ns) for each in ("", *parts_of(row.type))]
        for row in TOPICS
        if row in rows.values()
    }
    every = [table for group in tables.values() for table in group]
    unreadable, unknown = Counter[str](), Counter[str]()
    messages = 0
    with new_folder(out, force) as folder:
        with ExitStack() as stack:
            for table in every:
                table.sink = open_sink(
                    folder / f"{table.name}.{format}", table.gatherer.form, _notes(recording, table)
                )
                stack.callback(table.sink.close)
            for record in recording.selected(selection):
                messages += 1
                if record.topic not in rows:
                    unknown[record.topic] += 1
                    continue
                try:
                    message = record.decode()
                except MessageError:
                    unreadable[record.topic] += 1
                    continue
                for table in tables[rows[record.topic].pattern]:
                    table.add(record, message)
            for table in every:
                table.flush()
                unreadable += table.gatherer.unreadable
        exported = Exported(
            recordings=tuple(map(str, recording.paths)),
            out=str(out),
            format=format,
            scenario=recording.metadata.get("scenario", ""),
            messages=messages,
            unreadable=dict(sorted(unreadable.items())),
            unknown=dict(sorted(unknown.items())),
            complete=recording.complete,
            tables=tuple(table.info(format) for table in every),
        )
        (folder / INDEX).write_bytes(msgspec.json.format(msgspec.json.encode(exported)))
        (folder / SCENARIO).write_bytes(recording.scenario_json)
        (folder / README).write_text(_readme(recording, exported), encoding="utf-8")
    return exported


def _notes(recording: Recording, table: _Table) -> dict[str, str]:
    """What a file that was taken out of its folder should say of itself."""
    return {
        "recording": msgspec.json.encode(recording.metadata).decode(),
        "scenario": recording.scenario_json.decode(),
        "topics": table.topics,
        "type": table.row.type.__name__,
        "each": table.each,
    }


@contextmanager
def new_folder(out: Path, force: bool, mark: str = INDEX) -> Iterator[Path]:
    """A folder to write into, which becomes `out` when all has gone well, and goes when it has not. An
    earlier one is known by the file `mark` in it.

    Raises:
        ArgumentError: `out` exists, and is no earlier export or not to be replaced.
        ManipleError: it can't be written.
    """
    try:
        out = out.resolve()
        _require_free(out, force, mark)
        scratch = out.with_name(f".{out.name}-{token_hex(4)}")
        new, old = scratch / "new", scratch / "old"
        try:
            new.mkdir(parents=True)
            yield new
            if out.exists():
                out.rename(old)
            new.rename(out)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
    except OSError as error:
        raise ManipleError(f"{out}: can't write the export: {error.strerror or error}") from None


def _require_free(out: Path, force: bool, mark: str) -> None:
    """Refuse a folder that holds something else than an earlier export."""
    if out.exists() and not out.is_dir():
        raise ArgumentError(f"{out} is not a folder; --out must name one, or nothing that exists")
    if not out.is_dir() or next(out.iterdir(), None) is None:
        return
    if not (out / mark).exists():
        raise ArgumentError(f"{out} is not empty and holds no export; --out must name another folder")
    if not force:
        raise ArgumentError(f"{out} holds an export; another --out, or --force to replace it")


def _readme(recording: Recording, exported: Exported) -> str:
    """What is in the folder, for people."""
    made = recording.metadata
    lines = [
        f"# {exported.scenario}",
        "",
        f"Tables of {', '.join(path.name for path in recording.paths)}: a {made.get('mode', '?')} run, "
        f"seed {made.get('seed', '?')}, recorded by maniple {made.get('maniple', '?')}.",
        "",
        "`t_s` is when a message reached the recorder, in s since the first of the recording (`log_time_ns`: "
        "on the recorder's clock); `stamp_ns` when it was sent, on the clock of its sender. `topic`, "
        "`source`, `incarnation` and `seq` tell a message from every other; a table with an `index` has a "
        "row for each of several things in a message. Names end in their unit; `tables.json` has the units "
        "and kinds of all columns, `scenario.json` all parameters of the run.",
        "",
        "| file | topics | rows |",
        "|---|---|---|",
        *(f"| {table.file} | {table.topics} | {table.rows} |" for table in exported.tables),
    ]
    left_out = [*told(exported.complete, exported.unreadable, exported.unknown)]
    return "\n".join([*lines, *([""] + [f"- {line}" for line in left_out] if left_out else []), ""])


def told(complete: bool, unreadable: Mapping[str, int], unknown: Mapping[str, int]) -> Iterator[str]:
    """What is not in an export and might be looked for there, a line each."""
    if not complete:
        yield "the recording was not finished: only what is whole in it is here"
    for topic, count in unreadable.items():
        yield f"{topic}: {count} left out, no valid messages of this topic"
    for topic, count in unknown.items():
        yield f"{topic}: {count} left out, a topic that this version does not know"
