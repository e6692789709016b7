import json
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from maniple.core import codec, messages, topics
from maniple.core.errors import ArgumentError, MissingExtraError
from maniple.core.time import SECOND, VIRTUAL_EPOCH
from maniple.recording.columns import form, parts_of
from maniple.recording.reader import Recording, read
from maniple.recording.selection import Selection
from maniple.recording.table import Table, identity_of, table
from tests.recording.faulty import faulty_run
from tests.recording.traffic import Sent, drive, record, scan, traffic

HEAD = ("topic", "robot", "node", "t_s", "log_time_ns", "source", "incarnation", "seq", "stamp_ns", "index")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return faulty_run(tmp_path_factory.mktemp("run"))


@pytest.mark.parametrize("row", topics.TOPICS, ids=lambda row: row.pattern)
def test_every_field_has_a_column_or_rows_of_its_own(row: topics.Topic) -> None:
    names = [column.name for column in form(row.type, "", identity_of(row.pattern), 0).columns]
    assert len(set(names)) == len(names)
    for field in row.type.__struct_fields__:
        assert field in parts_of(row.type) or any(name.split(".")[0] == field for name in names)
    for each in parts_of(row.type):
        names = [column.name for column in form(row.type, each, identity_of(row.pattern), 0).columns]
        assert len(set(names)) == len(names)


@pytest.mark.parametrize("row", [row for row in topics.TOPICS if row.recorded], ids=lambda row: row.pattern)
def test_values_are_those_of_the_messages(run: Recording, row: topics.Topic) -> None:
    """Against the decoded messages as plain dicts, and arrays as `unpack_floats` gives them."""
    pattern = row.pattern.replace("{id}", "*")
    if not any(topics.topic(name) is row for name in run.topics):
        assert table(run, pattern).rows == 0
        return
    records = list(run.messages(lambda name: topics.topic(name) is row))
    found = table(run, pattern)
    assert found.rows == len(records) > 0
    assert found["topic"].tolist() == [record.topic for record in records]
    assert found["log_time_ns"].tolist() == [record.log_time_ns for record in records]
    first = next(run.messages()).log_time_ns
    assert found["t_s"].tolist() == [(record.log_time_ns - first) / SECOND for record in records]
    if "{id}" in row.pattern:
        assert found[identity_of(row.pattern)].tolist() == [record.topic.split("/")[1] for record in records]
    decoded = [record.decode() for record in records]
    for name, column in found.columns.items():
        if name in HEAD[:5]:
            continue
        values = found[name]
        for place, message in enumerate(decoded):
            assert _same(values[place], _value(message, name, column.parts)), (name, place)


@pytest.mark.parametrize(
    ("pattern", "each"),
    [
        (row.pattern.replace("{id}", "*"), each)
        for row in topics.TOPICS
        if row.recorded
        for each in parts_of(row.type)
        if each not in ("robots", "triangles", "chain")
    ],
)
def test_rows_for_what_a_message_has_several_of(run: Recording, pattern: str, each: str) -> None:
    found = table(run, pattern, each)
    pairs = [
        (record, place, element)
        for record in run.messages()
        if topics.topic(record.topic).pattern.replace("{id}", "*") == pattern
        for place, element in enumerate(getattr(record.decode(), each))
    ]
    assert found["index"].tolist() == [place for _, place, _ in pairs]
    assert found["log_time_ns"].tolist() == [record.log_time_ns for record, _, _ in pairs]
    for name in found:
        own = name.removeprefix(f"{each}.")
        if name not in HEAD:
            for value, (_, _, element) in zip(found[name], pairs, strict=True):
                assert _same(value, _value(element, own, ()))


def test_rows_of_arrays_that_belong_together(run: Recording) -> None:
    robots = table(run, "sim/truth", "robots")
    whole = table(run, "sim/truth")
    count = len(run.scenario.robots)
    assert robots.rows == count * whole.rows
    assert robots["robot"][:count].tolist() == list(whole["robots"][0])
    for place, name in enumerate(("x_m", "y_m", "psi_rad")):
        assert np.array_equal(robots[name].reshape(-1, count), whole["poses"][:, :, place])
    assert np.array_equal(robots["clearance_m"].reshape(-1, count), whole["clearances"])
    assert _masked(robots["v_mps"]).mask.all()
    state = table(run, messages.FormationState)
    triangles = table(run, messages.FormationState, "triangles")
    known = np.isfinite(state["errors"][..., 3])
    assert np.array_equal(triangles["p_m"], state["errors"][..., 3][known])
    assert triangles["robots"][0] == "|".join(state["chain"][known.any(axis=1)][0][:3])
    chain = table(run, messages.FormationState, "chain")
    assert np.array_equal(chain["y_m"], state["points"][..., 1][np.isfinite(state["points"][..., 1])])


def test_arrays_of_different_lengths_end_in_nan(tmp_path: Path) -> None:
    ranges = [[1.0, 2.0, 3.0], [], [0.1]]
    sent = [Sent("hw/r1/scan", scan(i, messages.pack_floats(one)), i, i, i) for i, one in enumerate(ranges)]
    found = table(read(record(tmp_path / "a.mcap", sent)), "hw/r1/scan")
    expected = np.array([[1, 2, 3], [np.nan] * 3, [0.1, np.nan, np.nan]], dtype=np.float32)
    assert np.array_equal(found["ranges"], expected, equal_nan=True)
    assert found["ranges"].dtype == np.float32
    assert found["beams"].shape == (3, 0, 3)
    assert [one.tolist() for one in found.to_pandas()["ranges"]] == [
        np.array(one, dtype=np.float32).tolist() for one in ranges
    ]
    assert found.to_arrow()["ranges"].to_pylist() == [
        np.array(one, dtype=np.float32).tolist() for one in ranges
    ]


def test_whole_numbers_that_may_lack_stay_exact(run: Recording) -> None:
    found = table(run, "robot/*/odometry")
    stamps = _masked(found["applied.stamp_ns"])
    assert stamps.mask.any()
    assert not stamps.mask.all()
    assert stamps.dtype == np.int64
    assert stamps.compressed().min() >= VIRTUAL_EPOCH
    column = found.to_pandas()["applied.stamp_ns"]
    assert column.isna().tolist() == stamps.mask.tolist()
    assert column.dropna().tolist() == stamps.compressed().tolist()
    assert found["ticks"].shape == (found.rows, 2)


def test_a_recording_makes_its_tables(run: Recording) -> None:
    assert np.array_equal(run.table("sim/truth")["poses"], table(run, "sim/truth")["poses"])
    assert run.table(messages.Truth, "robots").rows == table(run, "sim/truth", "robots").rows


def test_pandas_and_arrow_hold_the_same(run: Recording) -> None:
    for wanted, each in [("robot/*/odometry", ""), ("sim/truth", "robots"), ("robot/*/status", "")]:
        found = table(run, wanted, each)
        frame, arrow = found.to_pandas(), found.to_arrow()
        assert list(frame.columns) == arrow.column_names == list(found)
        assert len(frame) == arrow.num_rows == found.rows
        assert frame["t_s"].tolist() == arrow["t_s"].to_pylist() == found["t_s"].tolist()
        assert frame["topic"].tolist() == arrow["topic"].to_pylist()
        assert frame.attrs["units"] == found.units
        assert {
            field.name: field.metadata[b"unit"].decode()
            for field in arrow.schema
            if b"unit" in (field.metadata or {})
        } == found.units
        arrow.validate(full=True)
    assert table(run, "robot/r2/odometry").units["x_m"] == "m"


def test_invalid_messages_are_counted(tmp_path: Path) -> None:
    sent = [*traffic(3), Sent("hw/r1/drive", b"\xff", VIRTUAL_EPOCH, 1, 0), Sent("what/is/it", b"?", 1, 1, 0)]
    found = table(read(record(tmp_path / "a.mcap", sent)), messages.Drive)
    assert found.rows == 6
    assert found.unreadable == {"hw/r1/drive": 1}
    assert repr(found).startswith("<Table of hw/r1/drive, hw/r2/drive: 6 rows of topic, robot, t_s")
    assert repr(found).endswith(", v_mps, without 1 invalid messages>")
    assert found.topics == ("hw/r1/drive", "hw/r2/drive")


def test_absurd_numbers_are_counted_as_invalid(tmp_path: Path) -> None:
    """Forged: the wire holds whole numbers up to 2^64."""
    good = codec.encode(
        messages.Motion(ticks=(2**63 - 1,), applied=(0.0, 0.0), state="active", controllable=True)
    )
    bad = codec.encode(messages.Motion(ticks=(2**63,), applied=(0.0, 0.0), state="active", controllable=True))
    sent = [Sent("hw/r1/motion", data, i, i, i) for i, data in enumerate((good, bad, good))]
    found = table(read(record(tmp_path / "a.mcap", sent)), "hw/*/motion")
    assert found.unreadable == {"hw/r1/motion": 1}
    assert found["log_time_ns"].tolist() == [0, 2]


def test_lives_are_told_apart(tmp_path: Path) -> None:
    lives = [(1, 0), (1, 1), (2, 0)]
    sent = [Sent("hw/r1/drive", drive(seq, "r1", life), 10 * life + seq, 0, 0) for life, seq in lives]
    found = table(read(record(tmp_path / "a.mcap", sent)), "hw/*/drive")
    assert list(zip(found["incarnation"].tolist(), found["seq"].tolist(), strict=True)) == lives


def test_a_selection_narrows_and_time_counts_from_the_recording(tmp_path: Path) -> None:
    recording = read(record(tmp_path / "a.mcap", traffic(40)))
    start = recording.start_ns
    selection = Selection(start + SECOND, start + SECOND + SECOND // 2, ("**",), ("hw/r2/*",))
    found = table(recording, "hw/*/drive", selection=selection)
    assert found.topics == ("hw/r1/drive",)
    assert found["t_s"].tolist() == pytest.approx([1 + 0.05 * k for k in range(10)])


def test_a_topic_without_messages_is_an_empty_table(run: Recording, tmp_path: Path) -> None:
    empty = read(record(tmp_path / "a.mcap", []))
    for recording, wanted in ((run, "formation/goal"), (empty, "sim/truth"), (empty, messages.Scan)):
        found = table(recording, wanted)
        assert found.rows == 0
        assert {len(column) for column in found.values()} == {0}
        assert len(found.to_pandas()) == found.to_arrow().num_rows == 0


@pytest.mark.parametrize(
    ("wanted", "each", "said"),
    [
        ("robot/r1/nothing", "", "no topic of .* matches 'robot/r1/nothing'; there are .*robot/r1/odometry"),
        ("robot/**", "", r"'robot/\*\*' matches topics of several types, .* robot/{id}/command \(Command\)"),
        (messages.Message, "", "Message is not the type of any topic"),
        ("sim/truth", "robot", "each = 'robot': Truth has robots"),
        ("robot/*/command", "x", "each = 'x': Command has none of those"),
        ("robot//x", "", "separated by single slashes"),
    ],
)
def test_what_is_not_there(run: Recording, wanted: Any, each: str, said: str) -> None:
    with pytest.raises(ArgumentError, match=said):
        table(run, wanted, each)


def test_a_column_that_is_not_there(run: Recording) -> None:
    found = table(run, "sim/truth")
    with pytest.raises(KeyError, match="no column 'x'; there are topic, t_s"):
        found["x"]
    assert "x" not in found


@pytest.mark.parametrize(("module", "convert"), [("pandas", Table.to_pandas), ("pyarrow", Table.to_arrow)])
def test_without_the_extra(
    run: Recording, monkeypatch: pytest.MonkeyPatch, module: str, convert: Any
) -> None:
    found = table(run, "sim/truth")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=r"pip install 'maniple\[export\]'"):
        convert(found)


def _masked(values: Any) -> np.ma.MaskedArray[Any, Any]:
    assert isinstance(values, np.ma.MaskedArray)
    return values


def _value(element: Any, name: str, parts: tuple[str, ...]) -> Any:
    """The value of a column by walking the message."""
    value = element
    for step in name.split("."):
        if value is None:
            return None
        if isinstance(value, tuple):
            return value[_place(name)]
        value = getattr(value, step)
    if isinstance(value, bytes) and parts:
        return messages.unpack_floats(value, len(parts) if len(parts) > 1 else None)
    return value


def _place(name: str) -> int:
    """Where the parts of tuples are, as the docstrings of the messages have it."""
    places = {"0": 0, "1": 1, "x": 0, "y": 1, "psi": 2, "u": 0, "w": 1, "v": 2}
    return places[name.split(".")[-1].split("_")[0]]


def _same(found: Any, expected: Any) -> bool:
    if expected is None:
        return found is None or found is np.ma.masked or (isinstance(found, float) and np.isnan(found))
    if isinstance(expected, np.ndarray):
        there = found[: len(expected)]
        return np.array_equal(there, expected) and bool(np.isnan(found[len(expected) :]).all())
    if isinstance(found, np.ma.MaskedArray):
        return bool(found.compressed().tolist() == list(expected))
    if isinstance(found, np.ndarray):
        return bool(found[~np.isnan(found)].tolist() == list(expected))
    if isinstance(found, str) and not isinstance(expected, str):
        return bool(json.loads(found) == json.loads(msgspec.json.encode(expected)))
    return bool(found == expected)
