import math
from pathlib import Path

import numpy as np
import pytest

from maniple.cli.loading import load, loads
from maniple.cli.way_file import LARGEST_FILE, samples_of, with_files
from maniple.core.errors import ScenarioError
from maniple.core.scenario.parse import to_json
from maniple.core.scenario.types import Csv, Line, Samples, Sequence
from tests.cli.scenes import SMALL, write

LINE = 'task = { kind = "line", start = [0, 0], end = [1.5, 0], speed_mps = 0.15, settle_s = 10.0 }'
WAY = b"t_s,x_m,y_m,psi_rad\n0,1,2,0\n2.5, 1.5 ,2,0.1\n\n4,2,2.5,0.3\n"


def test_a_file_is_samples() -> None:
    assert samples_of(WAY, settle_s=3.0) == Samples(
        times_s=(0.0, 2.5, 4.0), poses=((1.0, 2.0, 0.0), (1.5, 2.0, 0.1), (2.0, 2.5, 0.3)), settle_s=3.0
    )


def test_columns_may_come_in_any_order_after_a_byte_order_mark_and_lines_end_as_they_like() -> None:
    assert samples_of(b"\xef\xbb\xbfx_m,t_s,y_m\r\n1,0,2\r\n3,1,2\r\n").poses == ((1, 2, 0), (3, 2, 0))


def test_without_headings_it_faces_along_the_way() -> None:
    angles = np.linspace(0, 3, 61)
    rows = "".join(f"{10 * a},{4 * math.cos(a)},{4 * math.sin(a)}\n" for a in angles)
    headings = [pose[2] for pose in samples_of(f"t_s,x_m,y_m\n{rows}".encode()).poses]
    assert np.unwrap(headings) == pytest.approx(angles + math.pi / 2, abs=0.01)


def test_where_the_way_stands_it_faces_as_before_and_first_as_it_will() -> None:
    rows = "t_s,x_m,y_m\n0,0,0\n1,0,0\n2,0,0\n3,0,1\n4,0,2\n5,0,2\n6,0,2\n7,0,2\n"
    assert [pose[2] for pose in samples_of(rows.encode()).poses] == pytest.approx([math.pi / 2] * 8)
    assert samples_of(b"t_s,x_m,y_m\n0,1,1\n1,1,1\n").poses == ((1, 1, 0), (1, 1, 0))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "has 0 samples; must be at least 2"),
        (b"t_s,x_m,y_m\n0,0,0\n", "has 1 samples; must be at least 2"),
        (b"t_s,x_m\n0,0\n", "has the columns t_s, x_m; must be t_s, x_m, y_m [, psi_rad]"),
        (b"t_s,x_m,y_m,psi\n0,0,0,0\n", "has the columns t_s, x_m, y_m, psi; must be"),
        (b"t_s,x_m,y_m,y_m\n0,0,0,0\n", "has the columns t_s, x_m, y_m, y_m; must be"),
        (b"0,0,0\n1,1,1\n", "has the columns 0, 0, 0; must be"),
        (b"t_s,x_m,y_m\n0,0,0\n1,2\n", "line 3: has 2 values; must be 3, one a column"),
        (b"t_s,x_m,y_m\n0,0,0\n\n1,2,east\n", "line 4: y_m = 'east': must be a finite number"),
        (b"t_s,x_m,y_m\n0,0,nan\n", "line 2: y_m = 'nan': must be a finite number"),
        (b"t_s,x_m,y_m\n1,0,0\n2,0,0\n", "line 2: t_s = 1.0: must be 0 in the first line"),
        (b"t_s,x_m,y_m\n0,0,0\n0,0,0\n", "line 3: t_s = 0.0: must be at least 0.001 s after 0.0"),
        (b"t_s,x_m,y_m\n0,0,\xff\n", "line 2: byte 16 of the file is not UTF-8 text"),
        (b't_s,x_m,y_m\n0,0,"0\n', "line 2: not comma-separated values"),
        (b"t_s,x_m,y_m\n" + b"0,0,0\n" * (LARGEST_FILE // 6), "is larger than 4 MiB: not a way"),
    ],
)
def test_what_is_no_way(data: bytes, message: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        samples_of(data)
    assert message in str(caught.value)


def test_more_samples_than_anybody_needs() -> None:
    rows = "".join(f"{0.01 * k:.2f},0,0\n" for k in range(20_001))
    with pytest.raises(ScenarioError, match=r"^has more than 20000 samples$"):
        samples_of(f"t_s,x_m,y_m\n{rows}".encode())


def test_a_scenario_names_its_file_relative_to_itself(tmp_path: Path) -> None:
    (tmp_path / "way.csv").write_bytes(b"t_s,x_m,y_m\n0,0,0\n10,1,0\n20,2,0\n")
    scenario = load(write(tmp_path, SMALL.replace(LINE, 'task = { kind = "csv", file = "way.csv" }')))
    assert scenario.task == Samples(times_s=(0, 10, 20), poses=((0, 0, 0), (1, 0, 0), (2, 0, 0)))
    assert loads(to_json(scenario), form="json") == scenario, "no process needs the file again"


def test_a_file_that_is_wrong_is_named_with_the_task_and_the_scenario(tmp_path: Path) -> None:
    path = write(tmp_path, SMALL.replace(LINE, 'task = { kind = "csv", file = "no.csv" }'))
    with pytest.raises(ScenarioError) as caught:
        load(path)
    assert str(caught.value) == f"{path}: task.file = 'no.csv': can't be read: No such file or directory"


def test_every_part_of_a_sequence_is_loaded(tmp_path: Path) -> None:
    line = Line(start=(0, 0), end=(1, 0), speed_mps=0.1)
    (tmp_path / "a.csv").write_bytes(WAY)
    task = with_files(Sequence(tasks=(line, Csv(file="a.csv", settle_s=2.0))), tmp_path)
    assert task == Sequence(tasks=(line, samples_of(WAY, 2.0)))
    with pytest.raises(ScenarioError, match=r"^task\.tasks\[1\]\.file = 'b\.csv': can't be read"):
        with_files(Sequence(tasks=(line, Csv(file="b.csv"))), tmp_path)
    with pytest.raises(ScenarioError, match=r"^task\.file = '\.': can't be read: Is a directory$"):
        with_files(Csv(file="."), tmp_path)
    with pytest.raises(ScenarioError, match=r"can't be read: embedded null byte$"):
        with_files(Csv(file="a\0"), tmp_path)
