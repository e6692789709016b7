"""The folder of a sweep: rows as they come, and the table and pictures made of them at the end."""

import fcntl
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

import maniple
from maniple.cli.sweep.grid import Axis
from maniple.cli.sweep.plan import Job, Plan
from maniple.cli.sweep.rows import Kind, Row, columns
from maniple.core.errors import ArgumentError, ManipleError
from maniple.core.version import __version__

ROWS, TABLE, LOGS = "runs.jsonl", "results.parquet", "logs"


class Head(msgspec.Struct, frozen=True):
    """The first line of the file of rows."""

    sweep: str
    """Its name."""
    version: str
    """Of maniple."""
    code: str
    """Digest of its sources."""


class Folder:
    """Rows of a sweep, kept on disk: each is there as soon as `add` returns, whatever happens then.

    Raises:
        ArgumentError: the folder holds something else, another sweep, or is in use.
        ManipleError: it can't be read or written.
    """

    def __init__(self, path: Path, sweep: str, fresh: bool = False) -> None:
        self.path = path
        self.rows: dict[str, Row] = {}
        """By the identity of the run."""
        self.other_code = False
        """Whether rows were made by other sources of maniple than these."""
        try:
            _require_ours(path)
            path.mkdir(parents=True, exist_ok=True)
            self._file = (path / ROWS).open("a+b", buffering=0)
            self._lock()
            if fresh:
                self._clear()
            self._read(Head(sweep, __version__, code()))
        except OSError as error:
            raise ManipleError(f"{path}: {error.strerror or error}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def add(self, row: Row) -> None:
        """Keep a row.

        Raises:
            ManipleError: it can't be written.
        """
        try:
            self._file.write(msgspec.json.encode(row) + b"\n")
        except OSError as error:
            raise ManipleError(f"{self.path / ROWS}: {error.strerror or error}") from None
        self.rows[row.id] = row

    def log(self, job: Job) -> Path:
        """Where the recording of a run is kept; the folder is made."""
        (self.path / LOGS).mkdir(exist_ok=True)
        return self.path / LOGS / f"{job.id}.mcap"

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise ArgumentError(f"{self.path}: another sweep is writing there") from None

    def _clear(self) -> None:
        self._file.truncate(0)
        (self.path / TABLE).unlink(missing_ok=True)
        for log in (self.path / LOGS).glob("*.mcap"):
            log.unlink()

    def _read(self, head: Head) -> None:
        """Take in what is there; what a killed sweep left of a line goes."""
        self._file.seek(0)
        whole, _, rest = (data := self._file.read()).rpartition(b"\n")
        if rest:
            self._file.truncate(len(data) - len(rest))
        lines = whole.splitlines()
        if not lines:
            self._file.write(msgspec.json.encode(head) + b"\n")
            return
        try:
            found = msgspec.json.decode(lines[0], type=Head)
            rows = [msgspec.json.decode(line, type=Row) for line in lines[1:]]
        except msgspec.MsgspecError as error:
            self._file.close()
            raise ArgumentError(
                f"{self.path / ROWS}: not rows of a sweep ({error}); --fresh begins anew"
            ) from None
        if found.sweep != head.sweep:
            self._file.close()
            raise ArgumentError(f"{self.path}: holds the sweep {found.sweep!r}; another --out, or --fresh")
        self.rows = {row.id: row for row in rows}
        self.other_code = bool(rows) and found.code != head.code


def _require_ours(path: Path) -> None:
    """Refuse a folder with something in it that is no sweep's."""
    if path.exists() and not path.is_dir():
        raise ArgumentError(f"{path} is not a folder; --out must name one, or nothing that exists")
    if path.is_dir() and next(path.iterdir(), None) is not None and not (path / ROWS).exists():
        raise ArgumentError(f"{path} is not empty and holds no sweep; --out must name another folder")


def code() -> str:
    """Digest of the sources of maniple and the nodes."""
    root = Path(maniple.__file__).parents[1]
    digest = hashlib.blake2b(digest_size=8)
    for package in ("central_controller", "maniple", "robot_agent", "simulator"):
        for path in sorted((root / package).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def table(plan: Plan, rows: Mapping[str, Row]) -> dict[str, tuple[Kind, list[Any]]]:
    """The results, by column: kind and a value for each run, in the order of the grid.

    Axes come first, then seed, figures, the predicted delays, what was raised, and the overrides.
    """
    done = [(job, rows[job.id]) for job in plan.jobs if job.id in rows]
    found: dict[str, tuple[Kind, list[Any]]] = {}
    for index, axis in enumerate(plan.axes):
        found[axis.name] = axis_kind(axis), [job.values[index] for job, _ in done]
    found["seed"] = "int", [job.seed for job, _ in done]
    for column in columns():
        if column.name not in found:
            found[column.name] = column.kind, [row.figures.get(column.name) for _, row in done]
    found["tolerated_delay_s"] = "float", [job.tolerated_delay_s for job, _ in done]
    found["delay_margin_s"] = "float", [job.delay_margin_s for job, _ in done]
    found["error"] = "text", [row.error for _, row in done]
    found["overrides"] = "texts", [list(job.overrides) for job, _ in done]
    return found


def axis_kind(axis: Axis) -> Kind:
    """What the values of an axis are."""
    values = [level.value for level in axis.levels]
    if all(isinstance(value, bool) for value in values):
        return "bool"
    if any(isinstance(value, bool | str) for value in values):
        return "text"
    return "int" if all(isinstance(value, int) for value in values) else "float"


def write_table(
    path: Path, results: Mapping[str, tuple[Kind, Sequence[Any]]], notes: Mapping[str, str]
) -> None:
    """Write the results as Parquet; `notes` go with it as metadata. The same results give the same bytes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    types = {
        "float": pa.float64(),
        "int": pa.int64(),
        "bool": pa.bool_(),
        "text": pa.string(),
        "texts": pa.list_(pa.string()),
    }
    schema = pa.schema([(name, types[kind]) for name, (kind, _) in results.items()], metadata=dict(notes))
    arrays = [pa.array(_cells(kind, values), types[kind]) for kind, values in results.values()]
    part = path.with_suffix(".part")
    pq.write_table(pa.table(arrays, schema=schema), part, compression="zstd")
    part.replace(path)


def _cells(kind: Kind, values: Iterable[Any]) -> list[Any]:
    if kind == "text":
        return [
            value if value is None or isinstance(value, str) else msgspec.json.encode(value).decode()
            for value in values
        ]
    return list(values)
